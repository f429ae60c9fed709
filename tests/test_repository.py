"""Rules for the repository: requirements, imports, packaging, README."""

import ast
import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_versions_are_pinned_without_urls():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert len(pins) > 50
    for pin in pins:
        assert re.fullmatch(r"[A-Za-z0-9_.\-]+==[^ /]+( ; .+)?", pin), pin


def test_runtime_requirements_are_ranges_without_escnn():
    requirements = PYPROJECT["project"]["dependencies"]
    assert not [line for line in requirements if "==" in line or line.startswith("escnn")]
    assert "constraint-dependencies" not in PYPROJECT["tool"]["uv"]


def test_every_imported_package_is_required():
    """By the project or by an extra; `symview_eval.commands` knows which packages need an extra."""
    modules = {"cv2": "opencv-python-headless", "PIL": "pillow", "yaml": "pyyaml", "pybullet_data": "pybullet",
               "pybullet_utils": "pybullet", "rerun": "lerobot", "wandb": "lerobot"}  # fmt: skip
    project = PYPROJECT["project"]
    required = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-") for requirement in required}
    ours = {"lerobot_symview", "symview_sim", "lerobot_policy_symview", "symview_eval"}
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        for path in (ROOT / package).rglob("*.py"):
            for name in re.findall(r"^\s*(?:from|import) (\w+)(?:\.[\w.]+)?(?: import| as|$)", path.read_text(), re.M):
                if name not in ours and name not in sys.stdlib_module_names:
                    assert modules.get(name, name).replace("_", "-") in names, f"{path} imports {name}"


def test_only_escnn_import_imports_escnn():
    files = subprocess.check_output(
        ["git", "grep", "-lE", r"^\s*(from|import) escnn", "--", "*.py"], cwd=ROOT, text=True
    )
    assert files.split() == ["policies/lerobot_policy_symview/nn/escnn_import.py"]


def test_every_package_is_typed_and_documented():
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        assert (ROOT / package / "py.typed").is_file()
        assert (ROOT / package / "__init__.py").read_text().startswith('"""')


PACKAGES = {
    "lerobot_symview": "lerobot_symview",
    "symview_sim": "datasets_gen/symview_sim",
    "lerobot_policy_symview": "policies/lerobot_policy_symview",
    "symview_eval": "eval/symview_eval",
}
ALLOWED_IMPORTS = {
    "symview_sim": {"lerobot_symview"},
    "lerobot_policy_symview": {"lerobot_symview", "symview_sim"},
    "symview_eval": {"lerobot_symview", "symview_sim", "lerobot_policy_symview"},
    "lerobot_symview.errors": set(),
    "lerobot_symview.keys": set(),
    "lerobot_symview.registry": set(),
    "lerobot_symview.geometry": {"errors"},
    "lerobot_symview.views": {"geometry", "registry", "errors", "keys"},
    "lerobot_symview.calibration": {"geometry", "errors"},
    "lerobot_symview.runtime": {"views", "registry", "errors"},
    "lerobot_symview.kinematics": {"registry", "errors"},
    "lerobot_symview.datasets": {
        "calibration",
        "kinematics",
        "runtime",
        "views",
        "geometry",
        "registry",
        "errors",
        "keys",
    },
    "lerobot_policy_symview.symmetry": set(),
    "lerobot_policy_symview.encoders": set(),
    "lerobot_policy_symview.consistency": {"configuration", "symmetry"},
    "lerobot_policy_symview.configuration": {
        "consistency",
        "encoders",
        "inputs.feature_contract",
        "methods",
        "symmetry",
    },
    "lerobot_policy_symview.inputs": {"configuration", "symmetry"},
    "lerobot_policy_symview.nn": {"configuration", "encoders", "inputs", "symmetry"},
}
"""Package -> the packages it may import; subpackage -> the subpackages of its own package. There are no cycles."""
FORBIDDEN = {f"lerobot_symview.{name}": {"lerobot", "draccus"} for name in ("geometry", "views", "kinematics")}


def imported_modules(path):
    """Yield the names of the modules that a file imports at run time, at any level."""
    tree = ast.parse(path.read_text())
    typing_only = [
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    ]
    skipped = {id(node) for block in typing_only for node in ast.walk(block)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files_of(subpackage):
    package, *rest = subpackage.split(".")
    base = ROOT / PACKAGES[package] / Path(*rest)
    return sorted(base.rglob("*.py")) if base.is_dir() else [base.with_suffix(".py")]


@pytest.mark.parametrize("subpackage", ALLOWED_IMPORTS)
def test_imports_follow_the_allowed_direction(subpackage):
    package, _, inner = subpackage.partition(".")
    for path in files_of(subpackage):
        for module in imported_modules(path):
            owner = module.split(".")[0]
            assert owner not in FORBIDDEN.get(subpackage, ()), f"{path} imports {module}"
            if not inner:
                assert owner not in set(PACKAGES) - ALLOWED_IMPORTS[subpackage] - {package}, f"{path} imports {module}"
            elif owner == package and f"{module}.".removeprefix(f"{package}.").split(".")[0] != inner:
                allowed = [f"{package}.{name}." for name in ALLOWED_IMPORTS[subpackage]]
                assert f"{module}.".startswith(tuple(allowed)), f"{path} imports {module}"


@pytest.mark.parametrize("subpackage", ["geometry", "views", "calibration", "kinematics", "datasets"])
def test_library_errors_name_no_flags(subpackage):
    """Commands add the flag to an error. The modules excepted here are commands, or flags of one, or show commands."""
    commands = {"add_views.py", "convert_actions.py", "robot_flags.py", "hub.py", "card.py"}
    for path in files_of(f"lerobot_symview.{subpackage}"):
        tree = ast.parse(path.read_text())
        raised = [node for node in ast.walk(tree) if isinstance(node, ast.Raise)]
        texts = [part.value for node in raised for part in ast.walk(node) if isinstance(part, ast.Constant)]
        if path.name not in commands:
            assert not [text for text in texts if re.search(r"--[a-z]", str(text))], path


def test_readme_shows_the_commands_of_the_demo():
    readme = (ROOT / "README.md").read_text()
    for command in ("symview-generate", "symview-add-views", "lerobot-train", "lerobot-eval", "symview-preview"):
        assert f"\n{command} " in readme


def test_readme_is_short_and_its_links_exist():
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 120
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", readme):
        assert (ROOT / target).exists(), target
    assert (ROOT / "docs" / "images" / "orbit.gif").stat().st_size < 10**6


def test_public_names_exist_and_simulators_import_without_numba():
    import lerobot_symview

    assert all(getattr(lerobot_symview, name) is not None for name in dir(lerobot_symview))
    check = "import sys, symview_sim.env; sys.exit('numba' in sys.modules or 'lerobot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


@pytest.mark.long
def test_plugin_import_skips_network_view_and_simulator_modules():
    slow = "{'numba', 'escnn', 'pybullet', 'symview_sim.env', 'lerobot_policy_symview.modeling_symview_bc'}"
    check = f"import sys, lerobot_policy_symview; sys.exit(', '.join({slow} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

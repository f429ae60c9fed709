"""Rules about the repository itself."""

import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_versions_are_pinned_without_addresses():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert len(pins) > 50
    for pin in pins:
        assert re.fullmatch(r"[A-Za-z0-9_.\-]+==[^ /]+( ; .+)?", pin), pin


def test_what_is_installed_at_run_time_has_ranges_and_no_escnn():
    requirements = PYPROJECT["project"]["dependencies"]
    assert not [one for one in requirements if "==" in one or one.startswith("escnn")]
    assert "constraint-dependencies" not in PYPROJECT["tool"]["uv"]


def test_every_imported_package_is_required():
    """Of the packages that an extra installs, `symview_eval.commands` knows which."""
    modules = {"cv2": "opencv-python-headless", "PIL": "pillow", "yaml": "pyyaml", "pybullet_data": "pybullet",
               "pybullet_utils": "pybullet", "rerun": "lerobot", "wandb": "lerobot"}  # fmt: skip
    project = PYPROJECT["project"]
    required = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {re.match(r"[\w.-]+", one)[0].lower().replace("_", "-") for one in required}
    ours = {"lerobot_symview", "symview_sim", "lerobot_policy_symview", "symview_eval"}
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        for path in (ROOT / package).rglob("*.py"):
            for name in re.findall(r"^\s*(?:from|import) (\w+)(?:\.[\w.]+)?(?: import| as|$)", path.read_text(), re.M):
                if name not in ours and name not in sys.stdlib_module_names:
                    assert modules.get(name, name).replace("_", "-") in names, f"{path} imports {name}"


def test_only_its_own_modules_import_escnn():
    files = subprocess.check_output(
        ["git", "grep", "-lE", r"^\s*(from|import) escnn", "--", "*.py"], cwd=ROOT, text=True
    )
    assert files.split() == ["policies/lerobot_policy_symview/nn/escnn_import.py"]


def test_every_package_is_typed_and_documented():
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        assert (ROOT / package / "py.typed").is_file()
        assert (ROOT / package / "__init__.py").read_text().startswith('"""')


def test_packages_import_only_what_the_design_allows():
    forbidden = {
        "lerobot_symview": ("symview_sim", "lerobot_policy_symview", "symview_eval"),
        "datasets_gen/symview_sim": ("lerobot_policy_symview", "symview_eval"),
        "policies/lerobot_policy_symview": ("symview_eval",),
    }
    for package, others in forbidden.items():
        for path in (ROOT / package).rglob("*.py"):
            imported = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.MULTILINE)
            assert not set(imported) & set(others), path


def test_the_readme_shows_the_commands_the_demo_runs():
    readme = (ROOT / "README.md").read_text()
    for command in ("symview-generate", "symview-add-views", "lerobot-train", "lerobot-eval", "symview-preview"):
        assert f"\n{command} " in readme


def test_public_names_are_there_and_simulators_start_without_numba():
    import lerobot_symview

    assert all(getattr(lerobot_symview, name) is not None for name in dir(lerobot_symview))
    check = "import sys, symview_sim.env; sys.exit('numba' in sys.modules or 'lerobot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


def test_the_plugin_loads_without_what_only_networks_views_and_simulators_need():
    slow = "{'numba', 'escnn', 'pybullet', 'symview_sim', 'lerobot_policy_symview.modeling_symview_bc'}"
    check = f"import sys, lerobot_policy_symview; sys.exit(', '.join({slow} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

"""Rules about the repository itself."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_versions_are_pinned_without_addresses():
    pins = PYPROJECT["tool"]["uv"]["constraint-dependencies"]
    assert len(pins) > 50
    for pin in pins:
        assert re.fullmatch(r"[A-Za-z0-9_.\-]+==[^ /]+( ; .+)?", pin), pin


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


def test_the_readme_is_short_and_its_files_exist():
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 120
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", readme):
        assert (ROOT / target).exists(), target
    assert (ROOT / "docs" / "images" / "orbit.gif").stat().st_size < 10**6


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

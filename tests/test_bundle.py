"""The bundle for machines without a package index; a part of it, because packing the whole takes minutes."""

import importlib.util
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

TOOLS = Path(__file__).parent.parent / "tools"


def load(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


bundle, unpack = load("bundle"), load("unpack")


def bundled_files(name):
    return {str(path) for path, _ in bundle.files(distribution(name))}


def test_bundle_has_every_dependency_that_is_not_provided():
    packed = bundle.needed(["torch"])
    assert {"lerobot-policy-symview", "lerobot", "pybullet", "numba", "accelerate", "pyarrow", "sympy"} <= set(packed)
    assert not {"torch", "ray", "wandb"} & set(packed)
    assert not any(name.startswith("nvidia-") for name in packed)


def test_packages_import_without_the_files_that_are_left_out(tmp_path):
    """Two packages that import modules from their own tests; `unpack.py` checks the whole bundle."""
    for name in ("numpy", "scipy"):
        for relative, path in bundle.files(distribution(name)):
            (tmp_path / relative).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / relative).symlink_to(path)
    code = "import numpy.testing, scipy.fftpack; print(scipy.__file__)"
    command = [sys.executable, "-S", "-c", code]  # without `site`, installed packages are not on the import path
    environment = {"PYTHONPATH": str(tmp_path)}
    output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert output.startswith(str(tmp_path))


def test_own_packages_are_packed_completely():
    files = bundled_files("lerobot_policy_symview")
    assert {"symview_sim/env.py", "lerobot_symview/views/base.py", "symview_eval/experiments/paper/table1.csv"} <= files
    assert "symview_eval/templates/demo.html" in files
    assert any(file.endswith("dist-info/entry_points.txt") for file in files)


def test_only_the_assets_of_the_arms_are_packed():
    files = bundled_files("pybullet")
    assets = {file for file in files if file.startswith("pybullet_data/") and not file.endswith(".py")}
    assert "pybullet_data/franka_panda/panda.urdf" in assets
    assert {asset.split("/")[1] for asset in assets} <= set(bundle.ASSETS)


def test_unpacked_package_is_importable(tmp_path):
    packed = bundle.archive(distribution("draccus"), tmp_path)
    unpack.unpack(packed, tmp_path / "site")
    code = f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); import draccus; print(draccus.__file__)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.startswith(str(tmp_path / "site"))


@pytest.mark.parametrize("arguments", [[], ["a", "b"]])
def test_wrong_arguments_of_unpack_print_the_usage(arguments):
    done = subprocess.run(
        [sys.executable, TOOLS / "unpack.py", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "usage: python3 unpack.py FOLDER, with Python 3.12" in done.stderr

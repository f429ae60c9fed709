"""What is packed for machines without a package index. Packing all of it takes minutes, so a part is packed here."""

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


def places(name):
    return {str(place) for place, _ in bundle.files(distribution(name))}


def test_all_that_is_needed_is_found_and_what_is_provided_is_not():
    wanted = bundle.needed(["torch"])
    assert {"lerobot-policy-symview", "lerobot", "pybullet", "numba", "accelerate", "pyarrow", "sympy"} <= set(wanted)
    assert not {"torch", "ray", "wandb"} & set(wanted)
    assert not any(name.startswith("nvidia-") for name in wanted)


def test_what_is_left_out_is_not_imported(tmp_path):
    """Of those that import something of their tests; `unpack.py` checks the whole."""
    for name in ("numpy", "scipy"):
        for place, path in bundle.files(distribution(name)):
            (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / place).symlink_to(path)
    code = "import numpy.testing, scipy.fftpack; print(scipy.__file__)"
    command = [sys.executable, "-S", "-c", code]  # without `site`, Python does not see what is installed
    told = subprocess.run(command, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=True).stdout
    assert told.startswith(str(tmp_path))


def test_our_own_packages_go_along_whole():
    found = places("lerobot_policy_symview")
    assert {"symview_sim/env.py", "lerobot_symview/views/base.py", "symview_eval/experiments/paper/table1.csv"} <= found
    assert "symview_eval/templates/demo.html" in found
    assert any(place.endswith("dist-info/entry_points.txt") for place in found)


def test_only_the_assets_of_our_arms_go_along():
    found = {place for place in places("pybullet") if place.startswith("pybullet_data/") and not place.endswith(".py")}
    assert "pybullet_data/franka_panda/panda.urdf" in found
    assert {place.split("/")[1] for place in found} <= set(bundle.ASSETS)


def test_what_was_packed_is_imported_elsewhere(tmp_path):
    packed = bundle.archive(distribution("draccus"), tmp_path)
    unpack.unpack(packed, tmp_path / "site")
    code = f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); import draccus; print(draccus.__file__)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.startswith(str(tmp_path / "site"))


@pytest.mark.parametrize("arguments", [[], ["a", "b"]])
def test_wrong_use_of_unpack_is_told(arguments):
    done = subprocess.run(
        [sys.executable, TOOLS / "unpack.py", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "usage: python3 unpack.py FOLDER, with Python 3.12" in done.stderr

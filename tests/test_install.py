"""The contents of the wheel and the source archive, and the installation of the wheel with pip alone."""

import os
import subprocess
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "lerobot_symview": "lerobot_symview",
    "symview_sim": "datasets_gen/symview_sim",
    "lerobot_policy_symview": "policies/lerobot_policy_symview",
    "symview_eval": "eval/symview_eval",
}
OURS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "PIP_CONSTRAINT", "UV_CONSTRAINT", "NUMBA_BOUNDSCHECK")


def run(*command, fails=False):
    """Run a command outside this environment; return its standard output, or its standard error with `fails`."""
    clean = {name: value for name, value in os.environ.items() if name not in OURS}
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, env=clean, cwd=ROOT, check=False)
    assert (done.returncode != 0) == fails, (
        f"{words} ended with {done.returncode}:\n{done.stdout}\n{done.stderr[-8000:]}"
    )
    return done.stderr if fails else done.stdout


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Build the source archive, and the wheel from it, as for a release."""
    folder = tmp_path_factory.mktemp("dist")
    run(ROOT / "tools" / "uv.sh", "build", "--quiet", "--out-dir", folder)
    return folder


def files(package):
    """Return the paths in the wheel of a package's files, as git lists them."""
    listed = subprocess.check_output(["git", "ls-files", "-z", PACKAGES[package]], cwd=ROOT, text=True)
    return {f"{package}/{name.removeprefix(PACKAGES[package] + '/')}" for name in listed.split("\0") if name}


def test_wheel_has_exactly_the_files_of_the_packages(archives):
    (wheel,) = archives.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = set().union(*(files(package) for package in PACKAGES))
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert {"symview_eval/templates/demo.html", "symview_eval/experiments/paper/table1.csv"} <= names
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_source_archive_has_the_packages_and_no_tests(archives):
    (archive,) = archives.glob("*.tar.gz")
    with tarfile.open(archive) as stream:
        names = {name.partition("/")[2] for name in stream.getnames()}
    assert {"pyproject.toml", "constraints.txt", "LICENSE", "README.md"} <= names
    for folder in PACKAGES.values():
        listed = subprocess.check_output(["git", "ls-files", "-z", folder], cwd=ROOT, text=True)
        assert {name for name in listed.split("\0") if name} <= names
    assert not {name.split("/")[0] for name in names} & {".venv", ".tools", "tests", "results", "outputs", "data"}


@pytest.fixture
def programs():
    """Make a fresh virtual environment, 6 GB, and return the folder of its programs; remove it after use."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        yield Path(folder) / "bin"


@pytest.mark.install
def test_wheel_installed_with_pip_adds_views_and_trains(archives, programs, recorded, tmp_path):
    """With the package index's versions and without PyBullet, whose compilation takes minutes."""
    (wheel,) = archives.glob("*.whl")
    run(programs / "python", "-m", "pip", "install", "--quiet", "--no-compile", wheel)
    run(programs / "python", "-m", "pip", "check")
    installed = run(programs / "python", "-m", "pip", "list").lower()
    assert "lerobot_policy_symview" in installed
    assert not {"escnn", "pybullet"} & set(installed.split())

    report = run(programs / "symview-doctor")
    assert "!!" not in report
    assert "--policy.type=symview_bc" in report
    assert "lerobot_policy_symview[sim]" in report

    views = tmp_path / "views"
    new = ("--new_repo_id=test/installed", f"--new_root={views}", "--size=76", "--keep=[]")
    run(programs / "symview-add-views", "--dataset.repo_id=test/recorded", f"--dataset.root={recorded}", *new)
    policy = ("--policy.type=symview_bc", "--policy.width=16", "--policy.crop_size=64", "--policy.device=cpu")
    steps = ("--steps=2", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0", "--policy.push_to_hub=false")
    data = ("--dataset.repo_id=test/installed", f"--dataset.root={views}", f"--output_dir={tmp_path / 'policy'}")
    run(programs / "lerobot-train", *data, *policy, *steps)
    assert (tmp_path / "policy" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()

    remedy = "pip install 'lerobot_policy_symview[sim]'"
    error = run(programs / "symview-generate", fails=True)
    assert error == f"symview-generate: error: pybullet not installed: {remedy}\n"

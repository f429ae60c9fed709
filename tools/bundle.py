"""Packs what this environment has beside PyTorch, for a machine that has PyTorch, no package index, and little room.

    .venv/bin/python tools/bundle.py outputs/bundle        # once; then carry the folder, part by part if need be
    python3 unpack.py site && source site/activate         # there, in the folder: from any Python 3.12

Every distribution is an archive of its own, `part-NN/NAME.tar.xz`, no part is larger than --part-mib. Left out are
tests, type stubs, PyBullet's symbols and all of its assets but the arms', and what only logging and building need.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path, PurePosixPath

from packaging.requirements import Requirement
from tqdm import tqdm

ROOT = Path(__file__).parent.parent
OURS = "lerobot_policy_symview"
NEEDLESS = ("cmake", "wandb", "sentry-sdk", "gitpython", "gitdb", "smmap")  # to build, and for --wandb.enable=true
GPU_LIBRARIES = ("nvidia-", "cuda-", "triton")
ASSETS = ("franka_panda", "kuka_iiwa", "gripper", "cube.mtl")
SKIPPED_FOLDERS = {"tests", "test", "testing", "__pycache__", "include", "examples"}
SKIPPED_SUFFIXES = {".pyi", ".pyc", ".pyx", ".pxd", ".h", ".hpp", ".a", ".lib"}
# Imported without testing.
KEPT = ("numpy/testing", "numpy/_core/tests/_natype.py", "scipy/_lib", "pandas/_testing", "accelerate/test_utils")


def closure(requirements: list[str]) -> dict[str, Distribution]:
    """Return every installed distribution that the requirements lead to, by its normalised name."""
    found: dict[str, Distribution] = {}
    visited, todo = set(), [Requirement(text) for text in requirements]
    while todo:
        requirement = todo.pop()
        key = (_normal(requirement.name), frozenset(requirement.extras))
        if key in visited:
            continue
        visited.add(key)
        try:
            found[key[0]] = distribution(requirement.name)
        except PackageNotFoundError:  # for another system
            continue
        extras = ("", *requirement.extras)
        needs = [Requirement(text) for text in found[key[0]].requires or []]
        todo += [need for need in needs if not need.marker or any(need.marker.evaluate({"extra": e}) for e in extras)]
    return found


def needed(provided: Sequence[str]) -> dict[str, Distribution]:
    """Return every distribution but those that are provided, the GPU libraries that PyTorch brings, and the needless.

    PyTorch's small needs go along: another machine may have them in versions that are too old for the rest.
    """
    left_out = {_normal(name) for name in (*provided, *NEEDLESS)}
    found = closure([f"{OURS}[sim,escnn]"])
    return {name: one for name, one in found.items() if name not in left_out and not name.startswith(GPU_LIBRARIES)}


def files(installed: Distribution) -> Iterator[tuple[PurePosixPath, Path]]:
    """Yield where a distribution's files go and where they are."""
    for file in installed.files or []:
        path = Path(str(file.locate()))
        if ".." not in file.parts and path.is_file() and _is_needed(PurePosixPath(file)):
            yield PurePosixPath(file), path
    if installed.name == OURS:  # installed as a link to this folder
        packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
        for package in map(Path, packages["packages"]):
            for path in sorted((ROOT / package).rglob("*")):
                place = PurePosixPath(path.relative_to(ROOT / package.parent))
                if path.is_file() and _is_needed(place):
                    yield place, path


def archive(installed: Distribution, folder: Path) -> Path:
    """Write a distribution's archive and return it."""
    target = folder / f"{_normal(installed.name)}.tar.xz"
    # preset 2: 13 % larger than 6, three times faster
    with tarfile.open(target, "w:xz", preset=2) as stream, tempfile.TemporaryDirectory() as scratch:
        for place, path in files(installed):
            info = tarfile.TarInfo(str(place))
            compiled_here = installed.name == "pybullet" and path.suffix == ".so"  # wheels come without symbols
            content = _stripped(path, Path(scratch)) if compiled_here else path.read_bytes()
            info.size = len(content)
            stream.addfile(info, io.BytesIO(content))
    return target


def _stripped(path: Path, scratch: Path) -> bytes:
    """Return compiled code without symbols, or as it is where there is no `strip`."""
    program, copy = shutil.which("strip"), scratch / "code.so"
    if program is None:
        return path.read_bytes()
    shutil.copyfile(path, copy)
    subprocess.run([program, "--strip-unneeded", copy], check=True)  # noqa: S603
    return copy.read_bytes()


def _is_needed(place: PurePosixPath) -> bool:
    text = str(place)
    if place.parts[0] == "pybullet_data" and len(place.parts) > 1 and place.suffix != ".py":
        return place.parts[1] in ASSETS
    if text.startswith(KEPT):
        return True
    if text.startswith("pybullet_"):  # examples
        return text.startswith(("pybullet_data", "pybullet_utils"))
    return not SKIPPED_FOLDERS & set(place.parts[:-1]) and place.suffix not in SKIPPED_SUFFIXES


def _normal(name: str) -> str:
    return name.lower().replace("_", "-")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the bundle goes")
    parser.add_argument("--part-mib", type=int, default=60, help="size of a part, unless one archive alone is larger")
    parser.add_argument("--provided", nargs="*", default=["torch"], help="what the other machine has")
    arguments = parser.parse_args()
    if arguments.folder.exists():
        parser.error(f"{arguments.folder} exists: remove it or name another folder")
    wanted = needed(arguments.provided)
    arguments.folder.mkdir(parents=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        packed = pool.map(lambda one: archive(one, arguments.folder), wanted.values())
        archives = list(tqdm(packed, desc="packing", total=len(wanted), unit="archive"))
    limit, sizes = arguments.part_mib * 2**20, {path: path.stat().st_size for path in archives}
    parts: list[list[Path]] = []
    for path in sorted(archives, key=lambda path: -sizes[path]):
        room = [part for part in parts if sum(sizes[one] for one in part) + sizes[path] <= limit]
        if not room:
            parts.append([])
        (room[0] if room else parts[-1]).append(path)
    for number, part in enumerate(parts):
        (arguments.folder / f"part-{number:02}").mkdir()
        for path in part:
            path.rename(arguments.folder / f"part-{number:02}" / path.name)
    shutil.copy(Path(__file__).with_name("unpack.py"), arguments.folder)
    total = sum(sizes.values()) / 2**20
    sys.stdout.write(f"{len(archives)} distributions, {total:.0f} MiB in {len(parts)} parts: {arguments.folder}\n")


if __name__ == "__main__":
    main()

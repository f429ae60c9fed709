"""Unpacks what `bundle.py` packed: `python3 unpack.py site && source site/activate`. Needs nothing but Python."""

import os
import subprocess
import sys
import tarfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

COMMANDS = {
    "lerobot-train": "lerobot.scripts.lerobot_train",
    "lerobot-eval": "lerobot.scripts.lerobot_eval",
    "symview-generate": "symview_sim.generate",
    "symview-add-views": "lerobot_symview.datasets.add_views",
    "symview-train-rl": "lerobot_policy_symview.rl.train_rl",
    "symview-experiment": "symview_eval.experiments.cli",
    "symview-benchmark": "symview_eval.benchmarks.cli",
}
MODULES = ", ".join([*COMMANDS.values(), "symview_eval.experiments.cells"])
CHECK = f"import pybullet, {MODULES}; print(pybullet.isNumpyEnabled())"
LAUNCHER = """\
#!{python}
import sys

from {module} import main

if __name__ == "__main__":
    sys.exit(main())
"""


def unpack(archive: Path, target: Path) -> None:
    """Unpack one archive."""
    with tarfile.open(archive) as stream:
        stream.extractall(target, filter="data")


def main() -> None:
    """Unpack every archive beside this file, in parallel, and write launchers and `activate`."""
    if len(sys.argv) != 2 or sys.version_info[:2] != (3, 12):
        sys.exit(f"usage: python3 unpack.py FOLDER, with Python 3.12 (this is Python {sys.version.split()[0]})")
    target = Path(sys.argv[1]).resolve()
    archives = sorted(Path(__file__).parent.glob("part-*/*.tar.xz"), key=lambda path: -path.stat().st_size)
    with ProcessPoolExecutor() as pool:
        list(pool.map(unpack, archives, [target] * len(archives)))
    programs = target / "bin"
    programs.mkdir(parents=True, exist_ok=True)
    for name, module in COMMANDS.items():
        (programs / name).write_text(LAUNCHER.format(python=sys.executable, module=module))
        (programs / name).chmod(0o755)
    (target / "activate").write_text(
        f'export PYTHONPATH="{target}${{PYTHONPATH:+:$PYTHONPATH}}" PATH="{programs}:$PATH" HF_HUB_OFFLINE=1\n'
    )
    environment = os.environ | {"PYTHONPATH": str(target)}
    found = subprocess.run(  # noqa: S603
        [sys.executable, "-c", CHECK], env=environment, capture_output=True, text=True, check=False
    )
    if found.stdout.strip() != "1":
        sys.exit(f"unpacked {len(archives)} archives, but they do not work with this Python:\n{found.stderr}")
    sys.stdout.write(f"unpacked {len(archives)} archives: source {target / 'activate'}\n")


if __name__ == "__main__":
    main()

"""Rewrites constraints.txt with the versions of a fresh resolution of every extra, without addresses."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
RESOLVE = ["pip", "compile", "pyproject.toml", "--all-extras", "--universal", "--upgrade"]
PLAIN = ["--no-annotate", "--no-header", "--quiet"]
HEADER = """\
# The versions with which the tests last passed, every extra included. `make pins` rewrites this file.
"""

command = [str(ROOT / "tools" / "uv.sh"), *RESOLVE, *PLAIN]
resolved = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout  # noqa: S603
CONSTRAINTS.write_text(HEADER + resolved)

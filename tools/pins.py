"""Rewrites the pinned versions in pyproject.toml with those that a fresh resolution yields, without addresses."""

import re
import subprocess
from pathlib import Path

PYPROJECT = Path(__file__).parent.parent / "pyproject.toml"
EXPORT = ["export", "--no-hashes", "--all-extras", "--no-emit-project", "--no-annotate", "--no-header", "--quiet"]
TABLE = re.compile(r"(?<=constraint-dependencies = \[\n).*?(?=\n?\])", re.DOTALL)

unpinned = TABLE.sub("", PYPROJECT.read_text())
PYPROJECT.write_text(unpinned)
command = [str(PYPROJECT.parent / "tools" / "uv.sh"), *EXPORT, "--upgrade"]
exported = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # noqa: S603
pins = "\n".join(f'    "{line}",' for line in exported.strip().splitlines())
PYPROJECT.write_text(TABLE.sub(lambda _: pins, unpinned, count=1))

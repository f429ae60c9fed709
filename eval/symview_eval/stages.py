"""Runs a pipeline of commands, each in its own process. A rerun skips finished stages."""

from __future__ import annotations

import json
import logging
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_symview.runtime.cli import CommandError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """One command of a pipeline.

    Args:
        name: short title, also used in the name of its log file.
        command: program and arguments; the program is taken from the folder of the running Python.
        result: file or folder that the command writes; it is removed before the command runs.
    """

    name: str
    command: tuple[str, ...]
    result: Path

    def __str__(self) -> str:
        return shlex.join(self.command)


def run_stages(stages: Sequence[Stage], folder: Path, environment: dict[str, str]) -> dict[str, float]:
    """Run `stages` in order.

    A stage is skipped if an earlier run finished it with the same command, its result exists and no stage before it ran
    again.

    Args:
        stages: the stages.
        folder: folder for the record of finished stages (`stages.json`) and the commands' output (`logs/`).
        environment: environment variables to set for the commands.

    Returns:
        Stage name -> seconds that its command took, in this run or the earlier one.

    Raises:
        CommandError: if a command fails; the message names its log.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record_file = folder / "stages.json"
    record: dict[str, dict[str, object]] = json.loads(record_file.read_text()) if record_file.exists() else {}
    stale = False
    for number, stage in enumerate(stages, start=1):
        done = record.get(stage.name)
        title = f"[{number}/{len(stages)}] {stage.name}"
        if not stale and done and done["command"] == str(stage) and stage.result.exists():
            logger.info("%s: finished earlier, in %.0f s", title, done["seconds"])
            continue
        stale = True
        record.pop(stage.name, None)
        _write(record_file, record)
        _remove(stage.result)
        logger.info("%s\n$ %s", title, stage)
        seconds = _run(stage, folder / "logs" / f"{number}-{stage.name.replace(' ', '-')}.log", environment)
        record[stage.name] = {"command": str(stage), "seconds": round(seconds, 1)}
        _write(record_file, record)
    return {stage.name: float(record[stage.name]["seconds"]) for stage in stages}  # type: ignore[arg-type]


def _run(stage: Stage, log: Path, environment: dict[str, str]) -> float:
    log.parent.mkdir(parents=True, exist_ok=True)
    program = Path(sys.executable).parent / stage.command[0]
    start = time.monotonic()
    with (
        log.open("wb") as stream,
        subprocess.Popen(  # noqa: S603  commands of this package only
            [str(program), *stage.command[1:]],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
        ) as process,
    ):
        assert process.stdout is not None
        try:
            while chunk := process.stdout.read1(4096):  # type: ignore[attr-defined]
                stream.write(chunk)
                sys.stderr.buffer.write(chunk)
                sys.stderr.flush()
        except BaseException:
            process.terminate()
            raise
    if process.returncode != 0:
        raise CommandError(f"stage {stage.name!r} failed with exit code {process.returncode}; see its output in {log}")
    return time.monotonic() - start


def _write(path: Path, record: dict[str, dict[str, object]]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(record, indent=2))
    partial.replace(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

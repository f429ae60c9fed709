"""Runs a documentation page: its files, commands and Python code, in the order of the page, at a small scale."""

import re
import shlex
import sys
import tomllib
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

from accelerate.state import AcceleratorState
from lerobot.utils.constants import HF_LEROBOT_HOME

from tests.helpers.packages import install

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
README = ROOT / "README.md"
SHELL_ONLY = {"make", "source", "python", "python3", "python3.12"}
"""Programs that are not run: neither ours nor LeRobot's, or set-up that the test environment already has."""
TRAINING = {"--steps": 2, "--batch_size": 2, "--policy.device": "cpu"}
NETWORK = {"--policy.width": 16, "--policy.crop_size": 64}
EVALUATION = {"--eval.n_episodes": 1, "--eval.batch_size": 1, "--env.max_steps": 2, "--policy.device": "cpu"}
SMALL = {
    "symview-generate": {"--num_episodes": 2, "--num_workers": 1, "--executor": "local"},
    "symview-add-views": {"--num_workers": 1},
    "symview-convert-actions": {"--num_workers": 1},
    "symview-calibrate": {},
    "symview-preview": {"--frames": 1, "--rerun": "false"},
    "symview-train-rl": TRAINING
    | NETWORK
    | {"--eval_every": 2, "--eval_episodes": 1, "--num_simulators": 1, "--env.max_steps": 2, "--save_every": 2},
    "symview-experiment": {"--scale": "smoke", "--num_workers": 1, "--device": "cpu", "--executor": "local"},
    "symview-experiment report": {},
    "symview-benchmark experts": {"--seeds": 2},
    "symview-benchmark views": {"--repeats": 3, "--frames": 0},
    "symview-doctor": {},
    "lerobot-train": TRAINING | {"--num_workers": 0, "--env_eval_freq": 0},
    "--policy.type=symview_bc": NETWORK,
    "--policy.type=act": {"--policy.pretrained_backbone_weights": "null"},  # the weights would be downloaded
    "--policy.type=diffusion": {
        "--policy.pretrained_backbone_weights": "null",
        "--policy.horizon": 8,
        "--policy.n_action_steps": 4,
        "--policy.drop_n_last_frames": 3,
        "--policy.down_dims": "[16, 32]",
    },
    "lerobot-eval": EVALUATION,
    "lerobot-rollout": {"--duration": 1, "--return_to_initial_position": "false", "--device": "cpu"},
    "lerobot-edit-dataset": {},
    "lerobot-dataset-viz": {"--save": 1, "--output-dir": "."},
}
"""Command, or flag of a command -> flags that are added after those of the page and override them."""


@dataclass(frozen=True)
class Block:
    """A fenced code block: its language, its text and the line where the text starts."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Return the fenced code blocks of a page, in order."""
    text = page.read_text()
    matches = re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [Block(match[1], match[2], text[: match.start()].count("\n") + 2) for match in matches]


def needs(page: Path) -> list[str]:
    """Return the datasets that a page requires, listed in its hidden `needs` comments."""
    return re.findall(r"^<!-- needs: (\S+) -->$", page.read_text(), re.MULTILINE)


def commands(text: str) -> list[list[str]]:
    """Return the commands of a shell block, each as its words."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


class Reader:
    """Runs pages in the current folder, as the Hub user `user`."""

    def __init__(self, user: str, monkeypatch):
        self._user, self._monkeypatch, self._names = user, monkeypatch, {"__name__": "__main__"}

    def dataset(self, name: str) -> Path:
        """Return the folder of a dataset that the page calls me/`name`."""
        return HF_LEROBOT_HOME / self._user / name

    def follow(self, page: Path) -> int:
        """Run the blocks of a page; return how many were run."""
        count = 0
        for block in blocks(page):
            text = re.sub(r"(?<![\w./-])me/", f"{self._user}/", block.text)
            file = re.match(r"# ([\w/.-]+\.(?:yaml|toml|py))\b", text)
            if file:
                Path(file[1]).parent.mkdir(parents=True, exist_ok=True)
                Path(file[1]).write_text(text)
            elif block.language == "bash":
                for words in commands(text):
                    self.run(words, f"{page.name}:{block.line}")
            elif block.language == "python":
                exec(compile("\n" * block.line + text, str(page), "exec"), self._names)  # page lines in tracebacks
            else:
                continue
            count += 1
        return count

    def run(self, words: list[str], location: str) -> None:
        """Run a command in this process; `location` is its page and line, for errors."""
        program = words[0]
        if words[:2] == ["pip", "install"]:
            if (Path(words[-1]) / "pyproject.toml").is_file():  # other packages are installed
                self._install(Path(words[-1]))
        elif program not in SHELL_ONLY:
            small = SMALL[" ".join(words[:2]) if " ".join(words[:2]) in SMALL else program]
            small = small | {flag: value for word in words[1:] for flag, value in SMALL.get(word, {}).items()}
            flags = [f"{flag}={value}" for flag, value in small.items()]
            self._monkeypatch.setattr(sys, "argv", [*words, *flags])
            (script,) = entry_points(group="console_scripts", name=program)
            AcceleratorState._reset_state(reset_partial_state=True)  # accelerate keeps one precision per process
            code = None
            try:
                script.load()()
            except SystemExit as end:
                code = end.code
            assert not code, f"{location}: {' '.join(sys.argv)} ended with {code}"

    def _install(self, project: Path) -> None:
        """Make a project's package and entry points importable, as an editable installation does."""
        project_table = tomllib.loads((project / "pyproject.toml").read_text())["project"]
        install(project, project_table["name"], project_table["entry-points"], self._monkeypatch)

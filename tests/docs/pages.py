"""Pages of the documentation as programs: their files, commands and code, in the order of the page, made small."""

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
"""Programs that are neither ours nor LeRobot's, or set up what a test has already."""
TRAINING = {"--steps": 2, "--batch_size": 2, "--policy.device": "cpu"}
NETWORK = {"--policy.width": 16, "--policy.crop_size": 64}
EVALUATION = {"--eval.n_episodes": 1, "--eval.batch_size": 1, "--env.max_steps": 2, "--policy.device": "cpu"}
SMALL = {
    "symview-generate": {"--num_episodes": 2, "--num_workers": 1, "--executor": "local"},
    "symview-add-views": {"--num_workers": 1},
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
    "--policy.type=act": {"--policy.pretrained_backbone_weights": "null"},  # which are downloaded from elsewhere
    "--policy.type=diffusion": {
        "--policy.pretrained_backbone_weights": "null",
        "--policy.horizon": 8,
        "--policy.n_action_steps": 4,
        "--policy.drop_n_last_frames": 3,
        "--policy.down_dims": "[16, 32]",
    },
    "lerobot-eval": EVALUATION,
    "lerobot-dataset-viz": {"--save": 1, "--output-dir": "."},
}
"""What a command, or one with a certain flag, gets beyond the flags of the page; the last counts."""


@dataclass(frozen=True)
class Block:
    """Something between two fences."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Return what a page has between fences, in order."""
    text = page.read_text()
    found = re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [Block(match[1], match[2], text[: match.start()].count("\n") + 2) for match in found]


def needs(page: Path) -> list[str]:
    """Return the datasets that a page takes for granted, of which a comment that is not shown tells."""
    return re.findall(r"^<!-- needs: (\S+) -->$", page.read_text(), re.MULTILINE)


def commands(text: str) -> list[list[str]]:
    """Return the commands of a shell block, each as its words."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


class Reader:
    """Somebody who does what a page says, as the user `user` on the Hub, in the present folder."""

    def __init__(self, user: str, monkeypatch):
        self._user, self._monkeypatch, self._names = user, monkeypatch, {"__name__": "__main__"}

    def dataset(self, name: str) -> Path:
        """Return the folder of a dataset that the page calls me/`name`."""
        return HF_LEROBOT_HOME / self._user / name

    def follow(self, page: Path) -> int:
        """Do it; return how many blocks there were something to do with."""
        done = 0
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
                exec(compile("\n" * block.line + text, str(page), "exec"), self._names)  # its lines in tracebacks
            else:
                continue
            done += 1
        return done

    def run(self, words: list[str], place: str) -> None:
        """Run a command in this process."""
        program = words[0]
        if words[:2] == ["pip", "install"]:
            if (Path(words[-1]) / "pyproject.toml").is_file():  # the others are here already
                self._install(Path(words[-1]))
        elif program not in SHELL_ONLY:
            small = SMALL[" ".join(words[:2]) if " ".join(words[:2]) in SMALL else program]
            small = small | {flag: value for word in words[1:] for flag, value in SMALL.get(word, {}).items()}
            flags = [f"{flag}={value}" for flag, value in small.items()]
            self._monkeypatch.setattr(sys, "argv", [*words, *flags])
            (script,) = entry_points(group="console_scripts", name=program)
            AcceleratorState._reset_state(reset_partial_state=True)  # a process has one precision
            code = None
            try:
                script.load()()
            except SystemExit as end:
                code = end.code
            assert not code, f"{place}: {' '.join(sys.argv)} ended with {code}"

    def _install(self, project: Path) -> None:
        """Have a project's package and entry points found, as an editable installation does."""
        facts = tomllib.loads((project / "pyproject.toml").read_text())["project"]
        install(project, facts["name"], facts["entry-points"], self._monkeypatch)

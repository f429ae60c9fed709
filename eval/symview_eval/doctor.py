"""`symview-doctor`: checks the installation for known problems and prints the remedies."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from collections.abc import Callable
from dataclasses import dataclass

from lerobot_symview.runtime.cli import CommandError, run_command

EXAMPLES = "  symview-doctor"

REINSTALL = "run `make setup` in a clone, or reinstall as docs/install.md says"
ESCNN = "1.0.11"  # the release that escnn_import.py patches
ESCNN_NEEDS = "'scipy<1.20' joblib pymanopt autograd"  # its requirements, without those that planar groups do not use


@dataclass(frozen=True)
class DoctorConfig:
    """Check the environment and print a remedy for everything that does not work, marked with `!!`.

    `--` marks what is optional and absent, or works slowly; `ok` the rest.
    """


@dataclass(frozen=True)
class Finding:
    """The result of a check.

    Args:
        text: one line.
        remedy: how to repair what does not work; empty if all is well.
        advice: how to install an optional package, or make one faster. Not an error.
    """

    text: str
    remedy: str = ""
    advice: str = ""


def check_python() -> Finding:
    """LeRobot 0.6 needs Python 3.12 or newer."""
    version = sys.version.split()[0]
    remedy = "" if sys.version_info >= (3, 12) else "use Python 3.12"
    return Finding(f"Python {version}", remedy)


def check_lerobot() -> Finding:
    """The plugin is written for LeRobot 0.6.1 and later 0.6 releases."""
    version = importlib.metadata.version("lerobot")
    release = tuple(int(part) for part in version.split(".")[:3])
    remedy = "" if (0, 6, 1) <= release < (0, 7) else "pip install 'lerobot[training,evaluation]>=0.6.1,<0.7'"
    return Finding(f"LeRobot {version}", remedy)


def check_plugin() -> Finding:
    """LeRobot finds plugins by the spelling of their distribution's name."""
    names = {distribution.metadata["Name"] for distribution in importlib.metadata.distributions()}
    if "lerobot_policy_symview" not in names:
        return Finding(
            "plugin not installed under a name that LeRobot recognises",
            "pip install lerobot_policy_symview, or `make setup` in a clone",
        )
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    missing = [f"--policy.type={n}" for n in ("symview_bc",) if n not in PreTrainedConfig.get_known_choices()]
    missing += [f"--env.type={n}" for n in ("symview",) if n not in EnvConfig.get_known_choices()]
    if missing:
        return Finding(
            f"plugin found, but {', '.join(missing)} not registered", "python -c 'import lerobot_policy_symview'"
        )
    return Finding("plugin discovered: --policy.type=symview_bc, --env.type=symview")


def check_torch() -> Finding:
    """Which device torch computes on; a CPU is enough for the demo."""
    import torch

    if torch.cuda.is_available():
        return Finding(f"torch {torch.__version__} on {torch.cuda.get_device_name()}")
    return Finding(f"torch {torch.__version__} on the CPU, {torch.get_num_threads()} threads: pass --policy.device=cpu")


def check_escnn() -> Finding:
    """Only the benchmark `policy` and the conversion of escnn's weights need escnn."""
    if not is_installed("escnn"):
        advice = f"pip install --no-deps escnn=={ESCNN} && pip install {ESCNN_NEEDS}"
        return Finding("escnn is not installed (optional, for a benchmark)", advice=advice)
    from lerobot_policy_symview.nn.escnn_import import gspaces

    space = gspaces.flipRot2dOnR2(4)
    return Finding(f"escnn {importlib.metadata.version('escnn')} imports, {space.name}")


def check_opencv() -> Finding:
    """Two OpenCV distributions overwrite each other's files."""
    installed = [
        name
        for name in (
            "opencv-python",
            "opencv-python-headless",
            "opencv-contrib-python",
            "opencv-contrib-python-headless",
        )
        if is_installed(name)
    ]
    remedy = "" if len(installed) == 1 else f"pip uninstall {' '.join(installed)}; pip install opencv-python-headless"
    import cv2

    return Finding(f"OpenCV {cv2.__version__} from {' and '.join(installed)}", remedy)


def check_pybullet() -> Finding:
    """The simulated tasks need pybullet; without numpy support it works, and renders more slowly."""
    if not is_installed("pybullet"):
        advice = "pip install 'lerobot_policy_symview[sim]'"
        return Finding("pybullet is not installed (optional, for the simulated tasks)", advice=advice)
    from symview_sim.bullet import REBUILD, pybullet

    if pybullet.isNumpyEnabled():
        return Finding("pybullet with numpy support")
    return Finding("pybullet was built without numpy support: rendering is slower", advice=REBUILD)


def check_mujoco() -> Finding:
    """Meta-World and FetchPush need MuJoCo, and a way to draw without a screen."""
    if not is_installed("mujoco"):
        advice = "pip install 'lerobot_policy_symview[metaworld,fetch]'"
        return Finding("mujoco is not installed (optional, for Meta-World and FetchPush)", advice=advice)
    from symview_sim.worlds.base import REMEDY, check_mujoco_import

    try:
        check_mujoco_import()
        import mujoco

        from symview_sim.worlds.rendering import MujocoRenderer

        MujocoRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except CommandError as error:
        return Finding(str(error).partition(";")[0], REMEDY)
    return Finding(f"MuJoCo {mujoco.__version__} draws without a screen")


def is_installed(name: str) -> bool:
    """Whether a distribution is installed."""
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


CHECKS: tuple[Callable[[], Finding], ...] = (
    check_python,
    check_lerobot,
    check_plugin,
    check_torch,
    check_escnn,
    check_opencv,
    check_pybullet,
    check_mujoco,
)


def diagnose(checks: tuple[Callable[[], Finding], ...] = CHECKS) -> list[Finding]:
    """Run every check; one that raises is a finding whose remedy is to install anew."""
    findings = []
    for check in checks:
        try:
            findings.append(check())
        except Exception as error:  # a broken package fails in ways of its own: that is the finding
            name = check.__name__.removeprefix("check_")
            findings.append(Finding(f"{name}: {type(error).__name__}: {error}", REINSTALL))
    return findings


def doctor(config: DoctorConfig) -> None:
    """Print every finding.

    Raises:
        CommandError: if anything is wrong.
    """
    findings = diagnose()
    for finding in findings:
        sys.stdout.write(f"{'!!' if finding.remedy else '--' if finding.advice else 'ok'}  {finding.text}\n")
        if finding.remedy:
            sys.stdout.write(f"    remedy: {finding.remedy}\n")
        elif finding.advice:
            sys.stdout.write(f"    to change that: {finding.advice}\n")
    wrong = sum(bool(finding.remedy) for finding in findings)
    if wrong:
        raise CommandError(f"{wrong} of {len(findings)} checks failed")


def main() -> None:
    """Run the console command."""
    run_command(DoctorConfig, doctor, EXAMPLES)

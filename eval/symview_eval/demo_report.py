"""The demo's report: one self-contained HTML page."""

from __future__ import annotations

import io
import json
import platform
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jinja2
from numpy.typing import NDArray

from lerobot_symview.datasets.source import SourceDataset
from symview_eval.contact_sheet import data_uri, png_uri
from symview_eval.preview import read_samples
from symview_eval.stages import Stage
from symview_eval.statistics import SuccessRate

LOSS_LINE = re.compile(r"step:\S+ .*?loss:(\S+)")
LOG_INTERVAL = re.compile(r"'log_freq': (\d+)")
FRAME = 2  # frame of the first demonstration to show: the gripper is moving and the arm is in the image
SHOWN_VIDEOS = 4
IMAGES = {
    "side": "side camera",
    "side_reproj": "reprojected (RGBD)",
    "side_persp": "perspective (RGB)",
    "top": "oracle (top-down camera)",
}
PACKAGES = ("lerobot_policy_symview", "lerobot", "torch", "pybullet", "numpy", "escnn")


@dataclass(frozen=True)
class LossPoint:
    """Mean training loss over the steps from the previous point to `step`."""

    step: int
    loss: float


def read_losses(log: Path) -> list[LossPoint]:
    """Return the losses in a log of `lerobot-train`.

    Steps are computed from the logged interval, since the log rounds them: step 1230 is written as 1K.
    """
    text = log.read_text(errors="replace")
    interval = int(LOG_INTERVAL.findall(text)[0])
    return [LossPoint(interval * (i + 1), float(loss)) for i, loss in enumerate(LOSS_LINE.findall(text))]


def read_success(evaluation: Path) -> SuccessRate:
    """Return the success rate in the output folder of `lerobot-eval`."""
    overall = json.loads((evaluation / "eval_info.json").read_text())["overall"]
    episodes = int(overall["n_episodes"])
    return SuccessRate(round(overall["pc_success"] / 100 * episodes), episodes)


def write_report(report: Path, stages: Sequence[Stage], seconds: dict[str, float]) -> None:
    """Write the page `report` from the results of the stages.

    Args:
        report: path of the page; its folder holds the stages' logs.
        stages: the demo's five stages.
        seconds: stage name -> seconds that it took.
    """
    recorded, views, _, evaluation, moved = (stage.result for stage in stages)
    images: dict[str, NDArray] = {}
    for folder in (recorded, views):
        images |= read_samples(SourceDataset(folder), None, 0, [FRAME])[0].stored
    template = jinja2.Environment(
        loader=jinja2.PackageLoader("symview_eval"), autoescape=True, undefined=jinja2.StrictUndefined
    ).get_template("demo.html")
    page = template.render(
        success=read_success(evaluation),
        moved=read_success(moved),
        images=[(title, png_uri(images[name])) for name, title in IMAGES.items()],
        videos=_videos(evaluation),
        moved_videos=_videos(moved),
        chart=_loss_chart(read_losses(next((report.parent / "logs").glob("*-training.log")))),
        stages=[(stage, seconds[stage.name]) for stage in stages],
        total=sum(seconds.values()),
        versions=installed_versions(),
        machine=f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    )
    report.write_text(page)


def _videos(evaluation: Path) -> list[str]:
    """Return the first episodes' videos as data URIs."""
    videos = sorted(evaluation.rglob("eval_episode_*.mp4"), key=lambda path: int(path.stem.rsplit("_", 1)[1]))
    return [data_uri("video/mp4", path.read_bytes()) for path in videos[:SHOWN_VIDEOS]]


def installed_versions() -> dict[str, str]:
    """Return the versions of those of `PACKAGES` that are installed."""
    versions = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def _loss_chart(points: Sequence[LossPoint]) -> str:
    """Return an SVG data URI of the loss over training steps, on a logarithmic axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    axes = figure.subplots()
    axes.semilogy([point.step for point in points], [point.loss for point in points], color="#1f5fa8")
    axes.set_xlabel("training step")
    axes.set_ylabel("mean squared error")
    axes.grid(alpha=0.3)
    stream = io.BytesIO()
    figure.savefig(stream, format="svg")
    return data_uri("image/svg+xml", stream.getvalue())

"""The page that describes a policy on the Hub, written from its configuration and what its evaluation found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from huggingface_hub import ModelCard, ModelCardData

from lerobot_policy_symview.configuration import SymviewConfig

TAGS = ("robotics", "lerobot", "symview", "equivariance")
SEEN = {
    "side": "the image of the camera `{camera}` itself",
    "top": "the image of an oracle's camera that hangs from above and does not see the arm",
    "reproj": "the RGBD image of the camera `{camera}`, reprojected to a view from above",
    "persp": "the RGB image of the camera `{camera}`, its table warped to lie flat",
}
LIMITS = """\
- It acts on one observation and one camera, whose calibration must be known, from the observation or stated.
- Symmetry ends where the robot does: reach, occlusion by the arm and lighting do not turn with the scene.
- Its actions are in the range of those it learned from; what it has not been shown it has not been tried on."""


def model_card(
    config: SymviewConfig,
    parameters: int,
    dataset: str,
    training: dict[str, Any],
    evaluation: Sequence[dict[str, float]] = (),
    tags: Sequence[str] = (),
) -> ModelCard:
    """Return the card of a policy.

    Args:
        config: the policy's.
        parameters: how many it has.
        dataset: the repository it learned from.
        training: name -> value of what else should be told of the training.
        evaluation: `step`, `success` and `return` of every evaluation there was.
        tags: further ones.
    """
    data = ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*TAGS, str(config.type), *tags])),
        datasets=[dataset],
        model_name=str(config.type),
    )
    repository = config.repo_id or "user/name"
    seen = SEEN.get(config.view.name, f"the view `{config.view.name}` of the camera `{{camera}}`").format(
        camera=config.camera
    )
    yaw = f"yaw as the representation `{config.theta_representation}`"
    sections = [
        f"---\n{data.to_yaml()}\n---\n",
        f"# {repository.split('/')[-1]}\n",
        f"A policy of lerobot_symview, a plugin of LeRobot: `{config.type}`, method `{config.method}`.\n",
        "## What it sees and how it acts\n",
        f"It sees {seen} ({config.modality.upper()}, {config.crop_size} pixels) and the gripper's state. Its network "
        f"({config.encoder}, group {config.group}, n = {config.width}, {parameters:,} parameters) "
        + ("has no symmetry built in.\n" if config.group == "C1" else "turns its action with what it sees.\n"),
        "| | entries, by how they move |\n|---|---|",
        f"| `observation.state` | {', '.join(config.state_symmetry)} |",
        f"| `action` | {', '.join(config.action_symmetry)}; {yaw} |\n",
        "## What it learned from\n",
        f"`{dataset}`; " + ", ".join(f"{name} {value}" for name, value in training.items()) + ".\n",
        "## How well it does\n",
        _evaluation(evaluation),
        "## Use it\n",
        f"```bash\nlerobot-eval --policy.path={repository} --env.type=symview --eval.n_episodes=50\n```\n",
        f"## Limits\n\n{LIMITS}\n",
    ]
    return ModelCard("\n".join(sections))


def _evaluation(evaluation: Sequence[dict[str, float]]) -> str:
    if not evaluation:
        return "The training did not evaluate it; the command below does.\n"
    rows = [f"| {row['step']:,.0f} | {100 * row['success']:.0f} % | {row['return']:.2f} |" for row in evaluation]
    return "\n".join(["| step | success | discounted return |", "|---|---|---|", *rows, ""])

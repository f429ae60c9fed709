"""The model card of a policy on the Hub, written from its configuration and its evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from huggingface_hub import ModelCard, ModelCardData

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.configuration_chunks import wrist_key

TAGS = ("robotics", "lerobot", "symview", "equivariance")
OBSERVATIONS = {
    "side": "the image of the camera `{camera}`, unchanged",
    "voxel": "the RGBD image of the camera `{camera}`, lifted to voxels",
    "point_cloud": "the RGBD image of the camera `{camera}`, lifted to points",
    "top": "the image of a true top-down camera, an oracle, without the arm",
    "reproj": "a top-down view, reprojected from the RGBD image of the camera `{camera}`",
    "persp": "a top-down view of the table, warped by a homography from the RGB image of the camera `{camera}`",
}
LIMITS = """\
- It acts on {observations}. The camera must be calibrated: the calibration is read from the
  observation or given in the configuration.
- Reach, occlusion by the arm and lighting break the symmetry: they do not rotate with the scene.
- Actions are limited to the range of the training data; nothing outside the training conditions has been tested."""


def model_card(
    config: SymviewConfig,
    parameters: int,
    dataset: str,
    training: dict[str, Any],
    evaluation: Sequence[dict[str, float]] = (),
    tags: Sequence[str] = (),
) -> ModelCard:
    """Return the model card of a policy.

    Args:
        config: the policy's configuration.
        parameters: number of trained parameters.
        dataset: repository of the training data.
        training: name -> value, further facts about the training.
        evaluation: `step`, `success` in [0, 1] and discounted `return` of each evaluation.
        tags: tags beside those of every policy.
    """
    data = ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*TAGS, str(config.type), *tags])),
        datasets=[dataset],
        model_name=str(config.type),
    )
    wrist = f", the image `{wrist_key(config)}` of a camera on the gripper" if wrist_key(config) else ""
    repository = config.repo_id or "user/name"
    size = "" if config.sees_points else f" ({config.modality.upper()}, {config.crop_size} pixels)"
    seen = config.encoder if config.sees_points else config.view.name
    observation = OBSERVATIONS.get(seen, f"the view `{config.view.name}` of the camera `{{camera}}`")
    yaw = f"yaw as the representation `{config.theta_representation}`"
    sections = [
        f"---\n{data.to_yaml()}\n---\n",
        f"# {repository.split('/')[-1]}\n",
        f"A `{config.type}` policy of lerobot_symview, a LeRobot plugin; method `{config.method}`.\n",
        "## Inputs and outputs\n",
        f"The observation is {observation.format(camera=config.camera)}{size}{wrist}, and the state. "
        f"The network ({config.encoder} encoder, group {config.group}, width {config.width}, "
        f"{parameters:,} parameters) is {_symmetry(config)}.\n",
        "| feature | representation of each dimension |\n|---|---|",
        f"| `observation.state` | {', '.join(config.state_symmetry)} |",
        f"| `action` | {', '.join(config.action_symmetry)}; {yaw} |\n",
        "## Training\n",
        f"Dataset `{dataset}`; " + ", ".join(f"{name} {value}" for name, value in training.items()) + ".\n",
        "## Evaluation\n",
        _evaluation(evaluation),
        "## Usage\n",
        f"```bash\nlerobot-eval --policy.path={repository} --env.type=symview --eval.n_episodes=50\n```\n",
        f"## Limits\n\n{LIMITS.format(observations=_observations(config))}\n",
    ]
    return ModelCard("\n".join(sections))


def _evaluation(evaluation: Sequence[dict[str, float]]) -> str:
    if not evaluation:
        return "Not evaluated during training; the command below evaluates it.\n"
    rows = [f"| {row['step']:,.0f} | {100 * row['success']:.0f} % | {row['return']:.2f} |" for row in evaluation]
    return "\n".join(["| step | success | discounted return |", "|---|---|---|", *rows, ""])


def _observations(config: SymviewConfig) -> str:
    """Return how many observations the policy sees, and how many actions it takes from them."""
    count, horizon = config.n_obs_steps, getattr(config, "horizon", 1)
    seen = ("a single observation" if count == 1 else f"the last {count} observations") + " of one camera"
    return seen if horizon == 1 else f"{seen} and predicts {horizon} actions"


def _symmetry(config: SymviewConfig) -> str:
    """Return how the policy's actions relate to transforms of the scene (paper sections 5.6 and 5.7)."""
    if config.group == "C1":
        return "not equivariant"
    if config.encoder == "relaxed":
        return "equivariant at initialisation; training relaxes this"
    if config.camera_direction:
        return "equivariant if the camera moves with the scene"
    return "equivariant: actions transform with the scene"

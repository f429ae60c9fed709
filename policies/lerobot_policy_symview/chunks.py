"""Base class of the policies that predict chunks of actions from one or several observations."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from lerobot_policy_symview.configuration_chunks import ChunkConfig, wrist_key
from lerobot_policy_symview.inputs.history import as_frames, history_length, latest, stacked, with_length
from lerobot_policy_symview.inputs.wrist import wrist_input
from lerobot_policy_symview.nn.encoders.base import Encoder
from lerobot_policy_symview.nn.encoders.wrist import WristEncoder
from lerobot_policy_symview.nn.layers import asymmetry
from lerobot_policy_symview.policy import MakeHead, Network, Stats, SymviewPolicy, scale_of
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.views.tracing import is_exporting


class ChunkPolicy(SymviewPolicy):
    """Predicts trajectories relative to the gripper's present pose and carries out their first actions.

    Training batches have actions (B, A), or chunks (B, H, A) with the flags `action_is_pad` (B, H); observations
    (B, ...) or, with a history, (B, T, ...). The start of an episode repeats its first observation.

    Args:
        config: the policy's configuration.
        make_head: makes the head on the features of all observations.
        dataset_stats: minimum, maximum, mean and standard deviation of states and actions in the dataset.
    """

    config: ChunkConfig
    has_noise: ClassVar[bool]
    """Whether chunks are made from noise."""

    def __init__(self, config: ChunkConfig, make_head: MakeHead, dataset_stats: dict[str, dict[str, Any]] | None):
        super().__init__(config, lambda fields, *others: make_head(config.n_obs_steps * fields, *others), dataset_stats)
        if config.action_mode == "absolute" and config.state_reader.converts:  # known once the calibration is read
            raise ValueError(
                "--policy.action_mode=absolute needs actions and states in one frame; these states count from the "
                f"{config.state_origin or 'base'}: record positions relative to the workspace's centre, or increments"
            )
        self._observations: deque[dict[str, Tensor]] = deque(maxlen=config.n_obs_steps)
        self._planned: deque[Tensor] = deque()

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load weights, as every policy does.

        Raises:
            ValueError: if they are those of a policy with other sizes of chunks.
        """
        for name in ("action_center", "network.head.denoiser.condition.weight"):
            saved, own = state_dict.get(name), self.state_dict().get(name)
            if saved is not None and own is not None and saved.shape != own.shape:
                raise ValueError(
                    f"the checkpoint has {name} of shape {tuple(saved.shape)}, this policy {tuple(own.shape)}: keep "
                    "--policy.horizon, --policy.n_obs_steps, --policy.width and --policy.denoiser_width as trained"
                )
        return super().load_state_dict(state_dict, strict, assign)

    def action_scale(self, action: Stats | None, state: Stats | None) -> tuple[Tensor, Tensor]:
        """Return centre and half-width, (A,) or (H, A), of the trajectories."""
        config = self.config
        if action is not None:
            return config.trajectories.scale(action, state, config.horizon)
        center, width = scale_of(None, config.actions)
        times = (config.horizon, 1) if config.horizon > 1 else (1,)
        return center.repeat(times), width.repeat(times)

    def make_encoder(self) -> Encoder:
        """Return the encoder of what `network_input` returns; with a gripper camera, it has further fields."""
        encoder = super().make_encoder()
        return encoder if self.config.wrist_camera is None else WristEncoder(encoder, self.config.width)

    @abstractmethod
    def scaled_chunk(self, network: Network, features: Tensor, noise: Tensor) -> Tensor:
        """Return scaled trajectories (B, H, A) for features (B, G, T n); the network is the trained or averaged one."""

    @abstractmethod
    def errors(self, features: Tensor, chunk: Tensor, is_pad: Tensor | None) -> Tensor:
        """Return the losses (B,) for features (B, G, T n) and scaled trajectories (B, H, A)."""

    def reset(self) -> None:
        """Start an episode: forget the observations and the planned actions."""
        super().reset()
        self._observations.clear()
        self._planned.clear()

    @property
    def history_length(self) -> int:
        """Number of observations that the network sees."""
        return self.config.n_obs_steps

    def transform_actions(self, actions: Tensor, transform: PlanarTransform) -> Tensor:
        """Return actions (B, A) for transformed scenes."""
        return self.config.trajectories.transform(actions, transform)

    def draw_noise(self, samples: int, generator: torch.Generator | None = None) -> Tensor:
        """Return noise (B, H, A) for chunks, drawn from PyTorch's random numbers or those of a generator."""
        center, config = self.action_center, self.config
        shape = (samples, config.horizon, len(config.action_symmetry))
        noise = torch.randn(shape, generator=generator, dtype=center.dtype) if self.has_noise else torch.zeros(shape)
        return noise.to(center)

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, Any]]:
        """Return the loss, mean or (B,), and metrics for the log.

        Only relaxed networks have a metric: reading a number from a GPU makes every step wait for it.
        """
        if self.training and self.config.aperture_noise:
            batch = batch | {keys.STATE: self._noisy(batch[keys.STATE])}
        state, actions, is_pad = latest(batch)[keys.STATE], batch[keys.ACTION], batch.get(f"{keys.ACTION}_is_pad")
        actions = actions if actions.ndim == 3 else actions[:, None]
        transform, crop_offset = None, None
        if self.training:
            transform, crop_offset = self.random_transform(state), torch.rand(len(state), 2, device=state.device)
        if transform is not None:
            chunks = [self.config.trajectories.transform(action, transform) for action in actions.unbind(1)]
            actions = torch.stack(chunks, dim=1)
            state = self.config.states.transform(state, transform, absolute_yaw=True)
        chunk = self.scaled(self.config.trajectories.relative(actions, state, is_pad))
        errors = self.errors(self._features(self.network, batch, transform, crop_offset), chunk, is_pad)
        output = {}
        if self.config.encoder == "relaxed":
            penalty = asymmetry(self.network)
            output["asymmetry"] = penalty.item()
            errors = errors + self.config.relaxation_weight * penalty
        return (errors if reduction == "none" else errors.mean()), output

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Return the next H actions (B, H, A) in physical units, in the declared order.

        Args:
            batch: observations (B, ...), or with a history (B, T, ...); a shorter history repeats its first one.
            noise: (B, H, A), from which chunks are made; by default it is drawn.
            **kwargs: LeRobot's, not used.

        Raises:
            DivergenceError: if an action is not finite.
            CalibrationError: as `select_action`.
        """
        self.eval()
        present = latest(batch)
        state = present[keys.STATE]
        self.check_first_image(present)
        noise = self.draw_noise(state.shape[0]) if noise is None else noise
        network = self.averaged or self.network
        with self.precision():
            scaled = self.scaled_chunk(network, self._features(network, batch), noise)
        actions = self.config.trajectories.actions_of(self.physical(scaled.to(state.dtype)), state)
        if not is_exporting():  # an exported program has no branches on values
            self.check_action(actions.flatten(0, 1), batch)
        return actions

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Return the action (B, A) for the observations (B, ...) that follow those of the last call.

        A chunk is predicted whenever all of its actions that are to be carried out have been.

        Raises:
            DivergenceError: if an action is not finite.
            CalibrationError: with `check_camera`, if the first image shows something else than the demonstrations.
        """
        if self.config.is_reactive:
            return self.predict_action_chunk(batch, noise=noise)[:, 0]
        self.check_first_image(batch)
        self._observations.append(self._seen(batch))
        if not self._planned:
            chunk = self.predict_action_chunk(stacked(self._observations), noise=noise)
            self._planned.extend(chunk[:, : self.config.n_action_steps].unbind(1))
        return self._planned.popleft()

    def network_input(
        self, batch: dict[str, Tensor], transform: PlanarTransform | None = None, crop_offset: Tensor | None = None
    ) -> tuple[Any, Tensor]:
        """Return the network's input: the observation and the state (B, D).

        With a gripper camera, the observation is a pair of the scene and that camera's images. Arguments are those of
        `SymviewPolicy.network_input`.

        Raises:
            KeyError: if the observations lack an image.
        """
        config, key = self.config, wrist_key(self.config)
        if key is None:
            return super().network_input(batch, transform, crop_offset)
        if key not in batch:
            raise KeyError(
                f"--policy.wrist_camera={config.wrist_camera} needs {key}, the observation has {sorted(batch)}: rename "
                "the camera's image with --rename_map"
            )
        scene = {name: values for name, values in batch.items() if name != key}  # no substitute for the policy's camera
        observation, state = super().network_input(scene, transform, crop_offset)
        images = wrist_input(batch[key], config.image_size, config.crop_size, transform, crop_offset)
        return (observation, images), state

    def _seen(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return what the network reads of observations: to stack a camera's images takes longer than to make views."""
        key = wrist_key(self.config)
        read = {*self.scene.keys, *self.scene.optional_keys}
        scene = self.scene.own_names({name: values for name, values in batch.items() if name != key})
        seen = {name: values for name, values in scene.items() if name in read}
        return seen if key not in batch else seen | {key: batch[key]}

    def _noisy(self, state: Tensor) -> Tensor:
        """Return states (..., S) with noise on the apertures."""
        apertures = self.config.states.of_type("aperture")
        noisy = state.clone()
        noisy[..., apertures] += self.config.aperture_noise * torch.randn_like(noisy[..., apertures])
        return noisy

    def _features(
        self,
        network: Network,
        batch: dict[str, Tensor],
        transform: PlanarTransform | None = None,
        crop_offset: Tensor | None = None,
    ) -> Tensor:
        """Return the features (B, G, T n) of all observations of the samples."""
        frames, count = self._frames(batch), self.history_length
        if count == 1:
            return network.encoder(*self.network_input(frames, transform, crop_offset))
        if transform is not None:
            transform = transform.repeated(count)
        if crop_offset is not None:
            crop_offset = crop_offset.repeat(count, 1)
        features = network.encoder(*self.network_input(frames, transform, crop_offset))
        history = features.view(count, -1, *features.shape[1:])
        return history.permute(1, 2, 0, 3).flatten(2)

    def _frames(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return T B frames; a history that is too short repeats its first observation."""
        count, has_time = self.history_length, history_length(batch) is not None
        if count == 1 and not has_time:
            return batch
        return as_frames(with_length(batch if has_time else stacked([batch]), count))

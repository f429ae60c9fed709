"""The updates of soft actor-critic from demonstrations (Haarnoja et al., 2018; Wang et al., 2022c)."""

from __future__ import annotations

import math
from copy import deepcopy
from pathlib import Path

import numpy as np
import torch
from lerobot.optim import load_optimizer_state, save_optimizer_state
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.inputs.observation_codec import ObservationCodec
from lerobot_policy_symview.modeling_symview_sacfd import SymviewSacfdPolicy
from lerobot_policy_symview.nn.critic import Critic
from lerobot_policy_symview.nn.layers import asymmetry
from lerobot_policy_symview.policy import not_finite
from lerobot_policy_symview.rl.replay import Sample
from lerobot_symview.errors import DivergenceError

WEIGHTS = "learner.safetensors"
METRICS = ("critic_loss", "actor_loss", "bc_loss", "q_value", "entropy", "temperature")

NetworkInput = tuple[Tensor, Tensor]
"""Observation and state (B, D), as the encoders take them."""


class Learner(nn.Module):
    """Actor, critic, target critic and temperature, with one Adam optimiser for each of the trained three.

    Args:
        policy: the actor.
        steps: updates of the whole training, over which `learning_rate_decay` anneals the rates of actor and critic.
    """

    def __init__(self, policy: SymviewSacfdPolicy, steps: int = 1):
        super().__init__()
        self.steps = steps
        config = policy.config
        device = policy.action_center.device
        self.config, self.policy, self.codec = config, policy, ObservationCodec(policy.scene)
        self.critic = Critic(config, policy.state_input).to(device)
        self.target = deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.initial_temperature), device=device))
        trained = {"actor": policy.get_optim_params(), "critic": self.critic.parameters()}
        trained["temperature"] = iter([self.log_temperature])
        self.optimizers = {
            name: torch.optim.Adam(parameters, lr=config.learning_rate) for name, parameters in trained.items()
        }
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        self.updates: Tensor

    def update(self, sample: Sample) -> tuple[NDArray[np.float32], dict[str, Tensor]]:
        """Take one step with every optimiser.

        The critic encodes each observation once: the actor's loss reads the features, detached, and the Q-functions
        from before the critic's step.

        Returns:
            The absolute TD errors (B,), averaged over the two Q-functions, and the scalar `METRICS`.

        Raises:
            DivergenceError: if a TD error is not finite. Weights that this step has spoilt show in the next one.
        """
        self.policy.train()
        device = self.log_temperature.device
        observation, next_observation, action = self.augment(sample)
        reward, weight = sample.reward.to(device), sample.weight.to(device)
        not_done, is_demo = (~sample.terminal).float().to(device), sample.is_demo.float().to(device)
        temperature = self.log_temperature.exp().detach()

        with torch.no_grad(), self.policy.precision():
            next_action, next_log_prob = self.policy.sample_action(*next_observation)
            next_q = self.target.q_functions(self.target.encoder(*next_observation), next_action)
            next_value = next_q.amin(dim=1) - temperature * next_log_prob
            td_target = reward + self.config.discount * not_done * next_value

        with self.policy.precision():
            features = self.critic.encoder(*observation)
            q = self.critic.q_functions(features, action)
            pi, log_pi = self.policy.sample_action(*observation)
            q_pi = self.critic.q_functions(features.detach(), pi).amin(dim=1)
        td_error = q - td_target[:, None]
        critic_loss = (weight[:, None] * td_error**2).mean(dim=0).sum()
        bc_error = functional.mse_loss(pi, action, reduction="none").mean(dim=1)
        bc_loss = (is_demo * bc_error).sum() / is_demo.sum().clamp(min=1)
        actor_loss = (temperature * log_pi - q_pi).mean() + self.config.bc_weight * bc_loss
        temperature_loss = -self.log_temperature * (log_pi.detach().mean() + self.config.entropy_target)
        if self.config.encoder == "relaxed":
            critic_loss = critic_loss + self.config.relaxation_weight * asymmetry(self.critic)
            actor_loss = actor_loss + self.config.relaxation_weight * asymmetry(self.policy.network)
        # The actor first: its loss leaves gradients in the Q-functions, which the critic's zero_grad removes.
        for name, loss in (("actor", actor_loss), ("critic", critic_loss), ("temperature", temperature_loss)):
            self.optimizers[name].zero_grad()
            loss.backward()
        if self.config.grad_clip_norm is not None:
            for network in (self.policy, self.critic):
                nn.utils.clip_grad_norm_(network.parameters(), self.config.grad_clip_norm)
        self._anneal()
        for optimizer in self.optimizers.values():
            optimizer.step()
        self._update_target()
        self.policy.update()
        values = (critic_loss, actor_loss, bc_loss, q.mean(), -log_pi.mean(), temperature)
        metrics = {name: value.detach() for name, value in zip(METRICS, values, strict=True)}
        td_errors: NDArray[np.float32] = td_error.detach().abs().mean(dim=1).cpu().numpy()
        if not np.isfinite(td_errors).all():
            raise DivergenceError("the critic's loss is not finite")
        return td_errors, metrics

    def augment(self, sample: Sample) -> tuple[NetworkInput, NetworkInput, Tensor]:
        """Return the network's input before and after the actions, and the actions (B, A).

        Each transition gets one random planar transform and one random crop offset, the same before and after.
        """
        device = self.log_temperature.device
        frames = self.codec.unpack(sample.frames, device)
        action = sample.action.to(device)
        transform = self.policy.random_transform(action)
        crop_offset = torch.rand(len(action), 2, device=device).repeat(2, 1)
        if transform is not None:
            action = self.config.actions.transform(action, transform, absolute_yaw=False).clamp(-1, 1)
            transform = transform.repeated(2)
        observation, state = self.policy.network_input(frames, transform, crop_offset)
        before, after = zip(observation.chunk(2), state.chunk(2), strict=True)
        return before, after, action

    def check_weights(self) -> None:
        """Check that the weights of actor, critic and target critic and the temperature are finite.

        Raises:
            DivergenceError: if not; the message names them.
        """
        names = not_finite(self.state_dict())
        if names:
            parts = dict.fromkeys(name.split(".")[0] for name in names)
            raise DivergenceError(f"weights are not finite, in {', '.join(parts)}")

    def save(self, folder: Path) -> None:
        """Write critic, target critic, temperature and optimisers; the policy saves the actor."""
        state = {name: value for name, value in self.state_dict().items() if not name.startswith("policy.")}
        save_file({name: value.contiguous() for name, value in state.items()}, folder / WEIGHTS)
        save_optimizer_state(self.optimizers, folder)

    def load(self, folder: Path) -> None:
        """Load what `save` wrote; the actor must have been loaded before."""
        state = load_file(folder / WEIGHTS)
        state |= {name: value for name, value in self.state_dict().items() if name.startswith("policy.")}
        self.load_state_dict(state)
        load_optimizer_state(self.optimizers, folder)

    def _anneal(self) -> None:
        if self.config.learning_rate_decay == "cosine":
            share = min(1.0, int(self.updates) / self.steps)
            for name in ("actor", "critic"):
                for group in self.optimizers[name].param_groups:
                    group["lr"] = self.config.learning_rate * (1 + math.cos(math.pi * share)) / 2

    @torch.no_grad()
    def _update_target(self) -> None:
        self.updates += 1
        if self.config.target_update == "polyak":
            tau = self.config.target_tau
        else:
            tau = float(int(self.updates) % self.config.target_interval == 0)
        if tau:
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, tau)

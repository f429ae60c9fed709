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
from lerobot_policy_symview.rl.replay import Sample

WEIGHTS = "learner.safetensors"
MEASURES = ("critic_loss", "actor_loss", "expert_loss", "value", "entropy", "temperature")


class Learner(nn.Module):
    """An actor, which is the policy, its critic, the critic's slow copy, the temperature, and what optimises them.

    Args:
        policy: the actor.
    """

    def __init__(self, policy: SymviewSacfdPolicy):
        super().__init__()
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

        The critic's convolutions see each observation once: the actor is judged by the features, and by the critic, of
        before the step.

        Returns:
            The errors of the estimated values (B,), for priorities, and the scalars `MEASURES` for the log.
        """
        self.policy.train()
        device = self.log_temperature.device
        seen, action = self._seen(sample)
        reward, weight = sample.reward.to(device), sample.weight.to(device)
        goes_on, expert = (~sample.terminal).float().to(device), sample.expert.float().to(device)
        temperature = self.log_temperature.exp().detach()
        (picture, state), following = seen

        with torch.no_grad(), self.policy.precision():
            next_action, next_log_density = self.policy.draw(*following)
            next_values = self.target.values(self.target.encoder(*following), next_action)
            worth = next_values.amin(dim=1) - temperature * next_log_density
            goal = reward + self.config.discount * goes_on * worth

        with self.policy.precision():
            features = self.critic.encoder(picture, state)
            values = self.critic.values(features, action)
            drawn, log_density = self.policy.draw(picture, state)
            judged = self.critic.values(features.detach(), drawn).amin(dim=1)
        errors = values - goal[:, None]
        critic_loss = (weight[:, None] * errors**2).mean(dim=0).sum()
        difference = functional.mse_loss(drawn, action, reduction="none").mean(dim=1)
        expert_loss = (expert * difference).sum() / expert.sum().clamp(min=1)
        actor_loss = (temperature * log_density - judged).mean() + self.config.expert_weight * expert_loss
        temperature_loss = -self.log_temperature * (log_density.detach().mean() + self.config.entropy)
        if self.config.encoder == "relaxed":
            critic_loss = critic_loss + self.config.relaxation_weight * asymmetry(self.critic)
            actor_loss = actor_loss + self.config.relaxation_weight * asymmetry(self.policy.network)
        # The actor's first: it leaves gradients in the critic's last layers, which the critic's own must not meet.
        for name, loss in (("actor", actor_loss), ("critic", critic_loss), ("temperature", temperature_loss)):
            self.optimizers[name].zero_grad()
            loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
        self._follow()
        self.policy.update()
        measures = (critic_loss, actor_loss, expert_loss, values.mean(), -log_density.mean(), temperature)
        told = {name: value.detach() for name, value in zip(MEASURES, measures, strict=True)}
        return errors.detach().abs().mean(dim=1).cpu().numpy(), told

    def save(self, folder: Path) -> None:
        """Write everything but the actor, which is the policy's to save."""
        state = {name: value for name, value in self.state_dict().items() if not name.startswith("policy.")}
        save_file({name: value.contiguous() for name, value in state.items()}, folder / WEIGHTS)
        save_optimizer_state(self.optimizers, folder)

    def load(self, folder: Path) -> None:
        """Take over what `save` wrote, beside an actor that was loaded."""
        state = load_file(folder / WEIGHTS)
        state |= {name: value for name, value in self.state_dict().items() if name.startswith("policy.")}
        self.load_state_dict(state)
        load_optimizer_state(self.optimizers, folder)

    def _seen(self, sample: Sample) -> tuple[tuple[tuple[Tensor, Tensor], ...], Tensor]:
        """Return what the networks get before and after the actions, and these, moved and cut alike at random."""
        device = self.log_temperature.device
        frames = self.codec.unpack(sample.frames, device)
        action = sample.action.to(device)
        motion = self.policy.random_transform(action)
        place = torch.rand(len(action), 2, device=device).repeat(2, 1)
        if motion is not None:
            action = self.config.actions.transform(action, motion, absolute_yaw=False).clamp(-1, 1)
            motion = motion.repeated(2)
        picture, state = self.policy.network_input(frames, motion, place)
        return tuple(zip(picture.chunk(2), state.chunk(2), strict=True)), action

    @torch.no_grad()
    def _follow(self) -> None:
        self.updates += 1
        if self.config.target_update == "polyak":
            rate = self.config.target_rate
        else:
            rate = float(int(self.updates) % self.config.target_interval == 0)
        if rate:
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, rate)

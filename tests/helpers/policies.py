"""Small policies and training batches for tests."""

from typing import Any

import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_symview.configuration import SymviewConfig
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.equivariance import example_observation
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.modeling_symview_sacfd import SymviewSacfdPolicy
from lerobot_policy_symview.policy import SymviewPolicy
from lerobot_symview import keys

STATS = {
    keys.ACTION: {
        "min": torch.tensor([-0.05, -0.03, -0.05, -0.6, 0.0]),
        "max": torch.tensor([0.04, 0.05, 0.05, 0.7, 1.0]),
        "mean": torch.tensor([0.0, 0.01, 0.0, 0.1, 0.5]),
        "std": torch.tensor([0.02, 0.02, 0.03, 0.3, 0.5]),
    }
}


def make_config(kind: type[SymviewConfig] = SymviewBcConfig, **options: Any) -> Any:
    config = kind(device="cpu", **({"width": 16, "crop_size": 64} | options))
    config.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(config.action_symmetry),))}
    return config


def make_policy(**options: Any) -> SymviewBcPolicy:
    torch.manual_seed(0)
    config = make_config(**options)
    return SymviewBcPolicy(config, dataset_stats=STATS if len(config.action_symmetry) == 5 else None)


def make_actor(**options: Any) -> SymviewSacfdPolicy:
    """An actor with random weights in its head too, which is zero-initialised: zeros would satisfy any symmetry."""
    torch.manual_seed(0)
    policy = SymviewSacfdPolicy(make_config(SymviewSacfdConfig, **options), dataset_stats=STATS)
    torch.nn.init.normal_(policy.network.head.linear.weight, std=0.1)
    return policy


def training_batch(config: SymviewConfig, batch: int = 4) -> dict[str, torch.Tensor]:
    """Random observations and unrelated random actions of either sign."""
    generator = torch.Generator().manual_seed(1)
    actions = torch.rand(batch, len(config.action_symmetry), generator=generator) - 0.5
    return example_observation(config, batch=batch) | {keys.ACTION: 0.1 * actions}


def take_training_steps(
    policy: SymviewPolicy, count: int = 3, rate: float = 1e-3, batch: dict[str, torch.Tensor] | None = None
) -> list[float]:
    policy.train()
    batch = training_batch(policy.config) if batch is None else batch
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=rate)
    losses = []
    for _ in range(count):
        loss, _ = policy.forward(dict(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        policy.update()
        losses.append(loss.item())
    return losses

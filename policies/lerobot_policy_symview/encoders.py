"""Registry of the encoders that `--policy.encoder` selects; importing it imports neither torch nor an encoder."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lerobot_symview.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lerobot_policy_symview.configuration import SymviewConfig
    from lerobot_policy_symview.nn.encoders.base import Encoder
    from lerobot_policy_symview.symmetry.groups import PlanarGroup

EncoderFactory = Callable[..., Any]
"""Takes the policy's configuration, its group and the state's representation (G, D, D); returns an `Encoder`."""

_CONVOLUTIONAL = "lerobot_policy_symview.nn.encoders.convolutional"
ENCODERS: Registry[EncoderFactory] = Registry(
    "encoder",
    "symview.encoders",
    {
        "equivariant": f"{_CONVOLUTIONAL}:equivariant",
        "plain": f"{_CONVOLUTIONAL}:plain",
        "relaxed": f"{_CONVOLUTIONAL}:relaxed",
        "voxel": "lerobot_policy_symview.nn.encoders.voxel:voxel",
        "point_cloud": "lerobot_policy_symview.nn.encoders.point_cloud:point_cloud",
    },
)

register_encoder = ENCODERS.register


def make_encoder(config: SymviewConfig, group: PlanarGroup, state: NDArray[np.float64]) -> Encoder:
    """Return the encoder that `config.encoder` names.

    Args:
        config: the policy's configuration.
        group: the symmetry group, of G elements.
        state: (G, D, D), the representation of the state vector, which is the network's second input.

    Raises:
        ValueError: if no encoder has that name.
    """
    encoder: Encoder = ENCODERS[config.encoder](config, group, state)
    return encoder

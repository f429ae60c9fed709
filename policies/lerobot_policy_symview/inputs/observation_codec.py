"""How preprocessed observations are remembered: colour as uint8, heights as float16, of the size that is needed."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.configuration import LIFTING, SymviewConfig
from lerobot_policy_symview.processor_views import metres_of_depth, metres_of_heights
from lerobot_policy_symview.symmetry.augmentation import scale_down

Frame = dict[str, NDArray[Any]]
"""What a network needs of one observation, packed."""


class FrameCodec:
    """Packs what a policy's network needs of preprocessed observations, and unpacks it.

    Args:
        config: the policy's.
    """

    def __init__(self, config: SymviewConfig):
        self._config = config

    def pack(self, batch: dict[str, Tensor]) -> list[Frame]:
        """Return a frame for each of B observations: colour in steps of 1/255, heights of 11 bits, in metres."""
        packed = {name: self._pack(name, batch[name]).cpu().numpy() for name in self._config.network_keys}
        return [{name: array[i] for name, array in packed.items()} for i in range(len(next(iter(packed.values()))))]

    def unpack(self, frames: dict[str, Tensor], device: torch.device) -> dict[str, Tensor]:
        """Return what was packed, stacked (B, ...), as observations on a device."""
        return {name: _unpack(values.to(device, non_blocking=True)) for name, values in frames.items()}

    def _pack(self, name: str, values: Tensor) -> Tensor:
        if values.ndim != 4:
            return values
        colored = name == self._config.color_key
        if not colored:  # first, since integers cannot be averaged
            values = metres_of_heights(values) if self._config.is_computed else metres_of_depth(values)
        if self._config.encoder not in LIFTING:
            values = scale_down(values, self._config.image_size)
        return (values * 255).round().to(torch.uint8) if colored else values.to(torch.float16)


def _unpack(values: Tensor) -> Tensor:
    if values.dtype == torch.uint8:
        return values.float() / 255
    return values.float() if values.dtype == torch.float16 else values

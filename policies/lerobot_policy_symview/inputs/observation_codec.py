"""Compact storage of preprocessed observations: colour as uint8, heights as float16, at the size that is needed."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_policy_symview.inputs.scene_input import SceneInput

StoredObservation = dict[str, NDArray[Any]]
"""The features of one observation that a network reads, packed."""


class ObservationCodec:
    """Packs the features of preprocessed observations that a policy's network reads, and unpacks them.

    Args:
        scene: the policy's input.
    """

    def __init__(self, scene: SceneInput):
        self._scene = scene

    def pack(self, batch: dict[str, Tensor]) -> list[StoredObservation]:
        """Return one entry for each of B observations: colour in steps of 1/255, heights with 11 bits, metres."""
        names = [*self._scene.keys, *(name for name in self._scene.optional_keys if name in batch)]
        packed = {name: self._pack(name, batch[name]).cpu().numpy() for name in names}
        return [{name: array[i] for name, array in packed.items()} for i in range(len(next(iter(packed.values()))))]

    def unpack(self, stored: dict[str, Tensor], device: torch.device) -> dict[str, Tensor]:
        """Return stacked stored observations (B, ...) as observations on a device."""
        return {name: _unpack(values.to(device, non_blocking=True)) for name, values in stored.items()}

    def _pack(self, name: str, values: Tensor) -> Tensor:
        if values.ndim != 4:
            return values
        values = self._scene.downscale(values)
        return (values * 255).round().to(torch.uint8) if values.shape[1] == 3 else values.to(torch.float16)


def _unpack(values: Tensor) -> Tensor:
    if values.dtype == torch.uint8:
        return values.float() / 255
    return values.float() if values.dtype == torch.float16 else values

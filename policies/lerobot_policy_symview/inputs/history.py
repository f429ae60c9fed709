"""Observations with a history: (B, T, ...) in LeRobot's batches, T B frames for encoders and views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_symview import keys

OBSERVATION = "observation."


def history_length(batch: Mapping[str, Any]) -> int | None:
    """Return T, the observations of each sample; None if the batch has no axis of time."""
    state = batch.get(keys.STATE)
    return state.shape[1] if isinstance(state, Tensor) and state.ndim == 3 else None


def as_frames(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a batch with observations (B, T, ...) as one with frames (T B, ...), all samples of a time together."""
    return {
        name: values.transpose(0, 1).flatten(0, 1) if _is_observed(name, values, axes=2) else values
        for name, values in batch.items()
    }


def as_history(frames: Mapping[str, Any], length: int) -> dict[str, Any]:
    """Return frames (T B, ...) as observations (B, T, ...): the inverse of `as_frames`."""
    return {
        name: values.view(length, -1, *values.shape[1:]).transpose(0, 1)
        if _is_observed(name, values, axes=1)
        else values
        for name, values in frames.items()
    }


def stacked(observations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return successive observations (B, ...) as one batch (B, T, ...) with the features that all of them have."""
    return {
        name: torch.stack([observation[name] for observation in observations], dim=1)
        for name, values in observations[-1].items()
        if _is_observed(name, values, axes=1) and all(name in observation for observation in observations)
    }


def latest(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return the present observations (B, ...) of a batch, with a history or without."""
    if history_length(batch) is None:
        return dict(batch)
    return {name: values[:, -1] if _is_observed(name, values, axes=2) else values for name, values in batch.items()}


def with_length(batch: Mapping[str, Any], length: int) -> dict[str, Any]:
    """Return observations (B, T, ...) as (B, length, ...): the latest ones, or with the first one repeated.

    Raises:
        ValueError: if there is no observation.
    """
    count = history_length(batch) or 0
    if not count:
        raise ValueError("the history has no observation")
    indices = [max(0, index) for index in range(count - length, count)]
    return {
        name: values[:, indices] if _is_observed(name, values, axes=2) else values for name, values in batch.items()
    }


def _is_observed(name: str, values: Any, axes: int) -> bool:
    """Whether a batch's entry is an observation of every sample: (B, ...), or with two axes (B, T, ...)."""
    return name.startswith(OBSERVATION) and isinstance(values, Tensor) and values.ndim >= axes

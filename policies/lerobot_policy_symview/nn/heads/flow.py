"""Flow matching over action chunks (Lipman et al., 2023), equivariant by construction.

A denoiser with shared weights is applied to every group element g, with the group axis as batch: it gets the noisy
chunk in the frame of g, which is an equivariant lift to regular fields, and the features of g. Its outputs, brought
back, are averaged. When the scene and the noise are transformed, so is the result.

The denoiser predicts the chunk at the end of the straight path from the noise, not the velocity: trajectories are
smooth, so that a small network can represent them, but not the noise (Li and He, 2025).
"""

from __future__ import annotations

import math

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

BLOCKS = 3
OCTAVES, HIDDEN = 6, 64  # frequencies and hidden numbers of the time's embedding
NOISE_SAMPLES = 4  # noisy chunks per observation and step: the denoiser costs little beside the encoder


class Denoiser(nn.Module):
    """Residual network on a flattened chunk, conditioned on features and time; its output is zero at initialisation.

    Args:
        fields: F, numbers per group element of the features.
        size: numbers of a chunk, H A.
        width: of the hidden layers.
    """

    def __init__(self, fields: int, size: int, width: int):
        super().__init__()
        self.width = width
        self.enter = nn.Linear(size, width)
        self.condition = nn.Linear(fields, BLOCKS * width)
        self.time = nn.Sequential(nn.Linear(2 * OCTAVES, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, BLOCKS * width))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(BLOCKS))
        self.widen = nn.ModuleList(nn.Linear(width, width, bias=False) for _ in range(BLOCKS))
        self.narrow = nn.ModuleList(nn.Linear(width, width) for _ in range(BLOCKS))
        self.leave = nn.Linear(width, size)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, chunk: Tensor, condition: Tensor, time: Tensor) -> Tensor:
        """Return the chunks (..., H A) that noisy chunks (..., H A) lead to.

        Args:
            chunk: noisy, in the frame of a group element.
            condition: (..., BLOCKS width), `condition` of that element's features.
            time: (..., BLOCKS width), `time_condition`.
        """
        hidden = self.enter(chunk)
        conditions = torch.split(condition + time, self.width, dim=-1)
        for norm, widen, narrow, shift in zip(self.norms, self.widen, self.narrow, conditions, strict=True):
            hidden = hidden + narrow(functional.silu(widen(norm(hidden)) + shift))
        end: Tensor = self.leave(functional.silu(hidden))
        return end

    def time_condition(self, time: Tensor) -> Tensor:
        """Return the condition (..., BLOCKS width) of times (...) in [0, 1]."""
        octaves = torch.arange(OCTAVES, device=time.device, dtype=time.dtype)
        angles = math.pi * time[..., None] * 2**octaves
        condition: Tensor = self.time(torch.cat([torch.cos(angles), torch.sin(angles)], dim=-1))
        return condition


class FlowHead(nn.Module):
    """Transports Gaussian noise to scaled action chunks; without noise, it is a regression of chunks.

    Args:
        fields: F, numbers per group element of the features.
        representation: (G, A, A), representation of the actions.
        horizon: H, actions of a chunk.
        width: of the denoiser.
        has_noise: whether chunks start from noise; else from zeros, and one integration step is exact.
    """

    representation: Tensor

    def __init__(self, fields: int, representation: NDArray, horizon: int, width: int, has_noise: bool = True):
        super().__init__()
        matrices = torch.tensor(representation, dtype=torch.get_default_dtype())
        self.register_buffer("representation", matrices, persistent=False)
        self.has_noise = has_noise
        self.denoiser = Denoiser(fields, horizon * matrices.shape[-1], width)

    def loss(self, features: Tensor, chunk: Tensor, is_pad: Tensor | None = None) -> Tensor:
        """Return the mean squared errors (B,) of the chunks predicted on the straight paths from noise to chunks.

        Args:
            features: (B, G, F).
            chunk: (B, H, A), scaled.
            is_pad: (B, H) bool, actions that do not count.
        """
        samples = NOISE_SAMPLES if self.has_noise else 1
        target = chunk.expand(samples, *chunk.shape)
        noise = torch.randn_like(target) if self.has_noise else torch.zeros_like(target)
        shape = (*target.shape[:2], 1, 1)
        time = target.new_zeros(shape)
        if self.has_noise:  # a sample's times are spread, one in each of as many equal intervals
            earliest = torch.arange(samples, device=chunk.device, dtype=chunk.dtype).view(-1, 1, 1, 1)
            time = (earliest + torch.rand_like(time)) / samples
        times = self.denoiser.time_condition(time[..., 0])
        end = self._end(torch.lerp(noise, target, time), self.denoiser.condition(features), times)
        errors = (end - target).square().mean(dim=(0, 3))
        if is_pad is None:
            return errors.mean(dim=1)
        counted = ~is_pad
        return (errors * counted).sum(dim=1) / counted.sum(dim=1).clamp(min=1)

    def forward(self, features: Tensor, noise: Tensor, steps: int = 1) -> Tensor:
        """Return chunks (B, H, A) by Euler's method.

        Args:
            features: (B, G, F).
            noise: (B, H, A), standard normal; zeros where chunks have no noise.
            steps: of the integration; without noise, 1 is exact.
        """
        condition = self.denoiser.condition(features)
        times = self.denoiser.time_condition(torch.arange(steps, device=noise.device, dtype=noise.dtype) / steps)
        chunk = noise
        for step, time in enumerate(times):
            chunk = chunk + (self._end(chunk, condition, time) - chunk) / (steps - step)
        return chunk

    def _end(self, chunk: Tensor, condition: Tensor, time: Tensor) -> Tensor:
        """Return the chunks (..., B, H, A) that noisy chunks (..., B, H, A) lead to.

        Args:
            chunk: noisy chunks.
            condition: (B, G, C), of the features.
            time: (..., B, 1, C) or (C,), of the times.
        """
        with torch.autocast(chunk.device.type, enabled=False):  # rho(g)^-1 is its transpose
            lifted = torch.einsum("gba,...hb->...gha", self.representation, chunk)
        end = self.denoiser(lifted.flatten(-2), condition, time)
        with torch.autocast(chunk.device.type, enabled=False):
            end = end.to(chunk.dtype).unflatten(-1, chunk.shape[-2:])
            return torch.einsum("gab,...ghb->...ha", self.representation, end) / len(self.representation)

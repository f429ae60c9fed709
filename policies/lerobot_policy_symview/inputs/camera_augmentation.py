"""Training images as of cameras that are calibrated, and measure depth, less well (`--policy.camera_augmentation`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from lerobot_policy_symview.inputs.observed_camera import ObservedCamera
from lerobot_symview import keys
from lerobot_symview.datasets.features import calibration_vectors
from lerobot_symview.geometry.miscalibration import Miscalibration

POSITION, ROTATION_DEG, FOCAL = 0.01, 1.0, 0.01  # largest errors of the calibration: metres, degrees, relative
DEPTH_NOISE, DROPOUT = 0.0025, 0.05  # standard deviation at 1 m, metres, and share of pixels without depth
HIDDEN_SIDE = 0.3  # largest side of the hidden rectangle, relative to the image's


def augment(
    observation: Mapping[str, Tensor], cameras: Iterable[ObservedCamera], strength: float, history: int = 1
) -> dict[str, Tensor]:
    """Return observations as of worse cameras; every sample has its own errors, drawn from PyTorch's random numbers.

    The stated position is off by up to 1 cm, the orientation by up to 1 degree and the focal length by up to 1 %, in
    random directions; depth has noise of 2.5 mm at 1 m, which grows with its square, and lacks 5 % of its pixels; in
    half of the frames a rectangle with sides of up to 30 % of the image's hides what is behind it. All this holds for
    the strength 1 and is proportional to it.

    Args:
        observation: images (B, C, H, W), colour in [0, 1] or uint8, depth in metres, and calibrations.
        cameras: whose images and calibration are changed.
        strength: of all errors.
        history: T, where B frames are B / T samples with T observations each, all samples of a time together. The
            calibration of a sample has one error.
    """
    changed = dict(observation)
    for camera in cameras:
        if keys.rgb(camera.name) not in observation or camera.missing_matrices(observation):
            continue
        changed |= _stated(observation, camera, strength, history)
        changed |= _measured(observation, camera, strength)
    return changed


def _stated(
    observation: Mapping[str, Tensor], camera: ObservedCamera, strength: float, history: int
) -> dict[str, Tensor]:
    """Return the calibration of each frame, (B, N), with errors."""
    seed = int(torch.randint(2**62, ()))
    cameras = camera.cameras(observation)
    rows = []
    for index, exact in enumerate(cameras):
        rng = np.random.default_rng([seed, index % (len(cameras) // history)])
        position, rotation_deg, focal = strength * rng.random(3) * (POSITION, ROTATION_DEG, FOCAL)
        rows.append(calibration_vectors(camera.name, Miscalibration(position, rotation_deg, focal).stated(exact, rng)))
    device = observation[keys.rgb(camera.name)].device
    return {key: torch.from_numpy(np.stack([row[key] for row in rows])).to(device) for key in rows[0]}


def _measured(observation: Mapping[str, Tensor], camera: ObservedCamera, strength: float) -> dict[str, Tensor]:
    """Return colour and depth with a hidden rectangle, and depth with errors."""
    key, depth_key = keys.rgb(camera.name), keys.depth(camera.name)
    color = observation[key]
    hidden = _rectangles(color.shape, HIDDEN_SIDE * strength, color.device)
    shade = torch.rand(len(color), 3, 1, 1, device=color.device)
    shade = shade if color.is_floating_point() else (shade * 255).to(color.dtype)
    images = {key: torch.where(hidden, shade.to(color.dtype), color)}
    if depth_key in observation:
        depth = observation[depth_key]
        hidden = torch.nn.functional.interpolate(hidden.float(), depth.shape[-2:]) > 0.5  # the sensor's own size
        noisy = depth + strength * DEPTH_NOISE * depth**2 * torch.randn_like(depth)
        lost = hidden | (torch.rand_like(depth) < strength * DROPOUT)
        images[depth_key] = torch.where(lost | ~(depth > 0), torch.zeros_like(depth), noisy.clamp(min=0.0))
    return images


def _rectangles(shape: torch.Size, largest: float, device: torch.device) -> Tensor:
    """Return (B, 1, H, W) bool, true in a random rectangle of half of the images."""
    count, _, height, width = shape
    inside = []
    for pixels in (height, width):
        side = min(largest, 1.0) * pixels * torch.rand(count, 1, device=device)
        start = (pixels - side) * torch.rand(count, 1, device=device)
        place = torch.arange(pixels, device=device)
        inside.append((place >= start) & (place < start + side))
    rows, columns = inside
    is_hidden = torch.rand(count, 1, 1, device=device) < 0.5
    return (rows[:, :, None] & columns[:, None, :] & is_hidden)[:, None]

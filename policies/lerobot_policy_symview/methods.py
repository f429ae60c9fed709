"""Presets of the policy's options for the methods that the paper compares."""

from __future__ import annotations

from typing import Any

EQUIVARIANT = {"encoder": "equivariant", "group": "D4", "camera_direction": False, "camera_rays": False}
REPROJECTED = EQUIVARIANT | {"view": "reproj", "modality": "rgbd", "gripper_input": "image"}
PERSPECTIVE = EQUIVARIANT | {"view": "persp", "modality": "rgb", "gripper_input": "image"}
SIDEVIEW = EQUIVARIANT | {"view": "side", "modality": "rgbd", "gripper_input": "vector"}
POINTS = SIDEVIEW | {"gripper_input": "image"}
PLAIN = {"encoder": "plain", "group": "C1"}
RELAXED = {"encoder": "relaxed"}
BROKEN = {"camera_direction": True}

METHODS: dict[str, dict[str, Any]] = {
    "reproj_equi": REPROJECTED,
    "persp_equi": PERSPECTIVE,
    "sideview_equi": SIDEVIEW,
    "oracle_equi": REPROJECTED | {"view": "top"},
    "sideview_nonequi": SIDEVIEW | PLAIN,
    "sideview_plucker": SIDEVIEW | PLAIN | {"camera_rays": True},
    "voxel_equi": POINTS | {"encoder": "voxel"},
    "point_cloud_equi": POINTS | {"encoder": "point_cloud"},
    "reproj_equi_relaxed": REPROJECTED | RELAXED,
    "reproj_equi_broken": REPROJECTED | BROKEN,
    "persp_equi_relaxed": PERSPECTIVE | RELAXED,
    "persp_equi_broken": PERSPECTIVE | BROKEN,
}
"""Method -> options of the policy, for the paper's Tables 1 to 3, and a baseline for cameras that move.

For RGB, the paper proposes `persp_equi_broken`, whose network also gets the direction to the camera. `sideview_plucker`
is not in the paper: its network gets the ray of every pixel of the camera's image."""

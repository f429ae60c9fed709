"""Rendered photographs of calibration boards: a lens, blur and noise applied to the printed pattern."""

import cv2
import numpy as np

from lerobot_symview.calibration.board import board_pattern, pixels_per_square
from lerobot_symview.calibration.board_corners import Corners
from lerobot_symview.geometry.camera import Camera, orbit_pose, project, transform

K = np.array([[615.3, 0, 319.5], [0, 615.1, 239.5], [0, 0, 1]])
PRINT, SAMPLES = (56, 72), 2  # pixels per square of the print; samples per pixel and axis
INK, PAPER, TABLE = 30, 235, 120  # grey levels


def photograph(board, camera, distortion=(), seed=0, noise=3.0, blur=0.7):
    """Return a photograph (H, W, 3) of a board at its place on a grey table."""
    square = pixels_per_square(board, *PRINT)
    pattern = np.pad(board_pattern(board, square), square // 2, constant_values=255)
    pattern = np.where(pattern > 127, PAPER, INK).astype(np.uint8)
    step = board.square / square
    edge = (0.5 - square // 2) * step
    board_from_print = np.array([[step, 0, edge], [0, -step, board.size[1] - edge], [0, 0, 1]])
    cam_from_board = camera.cam_from_world @ board.world_from_board
    fine_k = np.array([[SAMPLES, 0, (SAMPLES - 1) / 2], [0, SAMPLES, (SAMPLES - 1) / 2], [0, 0, 1.0]])
    fine_k = fine_k @ camera.intrinsics
    size = (SAMPLES * camera.width, SAMPLES * camera.height)
    fine_from_print = fine_k @ cam_from_board[:3, [0, 1, 3]] @ board_from_print
    image = cv2.warpPerspective(cv2.GaussianBlur(pattern, (0, 0), 1.2), fine_from_print, size, borderValue=TABLE)
    if len(distortion):
        v, u = np.indices(size[::-1], dtype=np.float32)
        ideal = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), fine_k, np.array(distortion), P=fine_k)
        u, v = ideal.reshape(*size[::-1], 2).transpose(2, 0, 1)
        image = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderValue=TABLE)
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), blur)
    image += noise * np.random.default_rng(seed).normal(size=image.shape)
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def camera_over(board, elevation, azimuth=0.0, distance=1.0, offset=(0.0, 0.0), roll=0.0):
    """A 640 x 480 camera that looks at a point near the board's centre; angles in degrees."""
    center = board.world_from_board @ [board.size[0] / 2 + offset[0], board.size[1] / 2 + offset[1], 0, 1]
    pose = orbit_pose(np.deg2rad(elevation), np.deg2rad(azimuth), distance, center[:3])
    cosine, sine = np.cos(np.deg2rad(roll)), np.sin(np.deg2rad(roll))
    pose[:3, :2] = pose[:3, :2] @ np.array([[cosine, -sine], [sine, cosine]])
    return Camera(K, pose, 480, 640)


def random_camera(board, rng, distance=1.0, elevation=(25, 80)):
    """A camera over the board, with any azimuth and roll."""
    azimuth, roll = rng.uniform(-180, 180, 2)
    return camera_over(board, rng.uniform(*elevation), azimuth, distance, rng.uniform(-0.05, 0.05, 2), roll)


def close_views(board, count=12, seed=0):
    """Cameras for intrinsics: near the board, from all sides."""
    rng = np.random.default_rng(seed)
    return [
        camera_over(
            board, rng.uniform(50, 75), 360 * index / count, rng.uniform(0.3, 0.42), rng.uniform(-0.05, 0.05, 2), roll
        )
        for index, roll in enumerate(rng.choice([0, 90, 180], count))
    ]


def ideal_corners(board, camera, noise=0.0, seed=0):
    """The corners of a board as a camera without distortion sees them, with noise in pixels."""
    on_table = transform(board.world_from_board, board.corners)
    pixels, _ = project(on_table, camera)
    return Corners(board.corners, pixels + noise * np.random.default_rng(seed).normal(size=pixels.shape))


def pose_errors(camera, world_from_cam):
    """Errors of a pose: rotation in degrees, position in millimetres."""
    difference = camera.cam_from_world @ world_from_cam
    rotation, _ = cv2.Rodrigues(difference[:3, :3])
    return float(np.rad2deg(np.linalg.norm(rotation))), 1000 * float(np.linalg.norm(difference[:3, 3]))

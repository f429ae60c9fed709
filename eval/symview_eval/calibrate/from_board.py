"""A camera's calibration from images of a board on the table."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from lerobot_symview.calibration.board import Board
from lerobot_symview.calibration.board_corners import (
    Corners,
    find_board,
    find_board_through_fisheye,
    find_board_through_lens,
)
from lerobot_symview.calibration.board_pose import (
    EstimatedIntrinsics,
    Intrinsics,
    board_pose,
    estimate_intrinsics,
    world_from_cam,
)
from lerobot_symview.calibration.read import ANY_POSE, read_intrinsics
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import Camera, from_ideal
from lerobot_symview.geometry.lens import EQUIDISTANT, lens_from_coefficients
from lerobot_symview.runtime.cli import flagged
from symview_eval.calibrate.config import CalibrateConfig
from symview_eval.calibrate.output import Result
from symview_eval.calibrate.photographs import Photographs, from_dataset, from_files
from symview_eval.live_camera import device_of, take_images

logger = logging.getLogger(__name__)


def photographs(config: CalibrateConfig) -> Photographs:
    """Return the images from the source that is given; none without a source."""
    if config.images is not None:
        with flagged("--images"):
            return from_files(config.images)
    if config.dataset is not None:
        with flagged("--dataset, --camera, --episodes"):
            return from_dataset(config.dataset.folder(), config.camera, config.episodes, config.frames)
    device = device_of(config)
    images = [] if device is None else take_images(device, config.frames)
    return {f"image {index}": image for index, image in enumerate(images)}


def from_board(config: CalibrateConfig) -> Result:
    """Return the camera from images of the board.

    Raises:
        CalibrationError: if the images do not determine it.
    """
    images = photographs(config)
    if not images:
        raise ValueError("give images of the board: --images, --dataset.repo_id or --device.type")
    sizes = {image.shape[:2] for image in images.values()}
    if len(sizes) > 1:
        listed = ", ".join(f"{width} x {height}" for height, width in sorted(sizes))
        raise CalibrationError(f"the images must be of one camera and size, got {listed}")
    pose_image = config.pose_image or next(iter(images))
    if pose_image not in images:
        raise ValueError(f"--pose_image={pose_image} is none of the images: {', '.join(images)}")
    image = images[pose_image]
    height, width = image.shape[:2]
    if config.intrinsics:
        intrinsics = _given_intrinsics(config, height, width)
    else:
        with flagged(f"{pose_image}, --board"):
            find_board(image, config.board)
        with flagged("--intrinsics, --images"):
            intrinsics = _reported(_estimated_intrinsics(images, config.board))
    with flagged(f"{pose_image}, --board"):
        corners = _find(image, config.board, intrinsics)
    with flagged(f"{pose_image}, --board, --intrinsics"):
        pose = board_pose(corners, intrinsics, width)
        lens = intrinsics.fisheye or lens_from_coefficients(None, intrinsics.distortion)
        world_from_camera = world_from_cam(pose, config.board.world_from_board)
        camera = Camera(intrinsics.matrix, world_from_camera, height, width, lens, intrinsics.depth_sensor)
    caption = f"{len(corners)} corners, reprojection error {pose.error_px:.2f} px, {pose.error_mm:.2f} mm on the table"
    logger.info(
        "%s: %s; board's orientation ± %.2f°, distance ± %.1f mm",
        pose_image,
        caption,
        pose.uncertainty_deg,
        pose.uncertainty_mm,
    )
    pixels = corners.pixels if intrinsics.fisheye is None else from_ideal(corners.pixels, camera)
    return Result(camera, image, pixels, caption)


def _find(image: NDArray[np.uint8], board: Board, intrinsics: Intrinsics) -> Corners:
    if intrinsics.fisheye is not None:
        height, width = image.shape[:2]
        camera = Camera(intrinsics.matrix, np.eye(4), height, width, intrinsics.fisheye)
        return find_board_through_fisheye(image, board, camera)
    if not intrinsics.distortion.any():
        return find_board(image, board)
    return find_board_through_lens(image, board, intrinsics.matrix, intrinsics.distortion)


def _estimated_intrinsics(images: Photographs, board: Board) -> EstimatedIntrinsics:
    """Estimate the intrinsics, then find the corners through the lens and estimate again; log images without board."""
    views = {}
    for name, image in images.items():
        try:
            views[name] = find_board(image, board)
        except CalibrationError as error:
            logger.warning("%s is not used: %s", name, error)
    height, width = next(iter(images.values())).shape[:2]
    first = estimate_intrinsics(views, height, width)
    return estimate_intrinsics({name: _find(images[name], board, first) for name in views}, height, width)


def given_camera(config: CalibrateConfig, size: tuple[int, ...] | None) -> Camera:
    """Return the camera of `--intrinsics`, at an arbitrary pose.

    Args:
        config: of the command.
        size: rows and columns of its images; None where only a calibration file tells.
    """
    if size is None:
        if "," in config.intrinsics:
            raise ValueError("--intrinsics=fx,fy,cx,cy needs --image_size='[rows, columns]' beside it")
        with flagged("--intrinsics"):
            camera = read_intrinsics(config.intrinsics, config.camera)
            size = camera.height, camera.width
    height, width = size
    intrinsics = _given_intrinsics(config, height, width)
    lens = intrinsics.fisheye or lens_from_coefficients(None, intrinsics.distortion)
    with flagged("--intrinsics"):
        return Camera(intrinsics.matrix, ANY_POSE, height, width, lens, intrinsics.depth_sensor)


def _given_intrinsics(config: CalibrateConfig, height: int, width: int) -> Intrinsics:
    """Return the intrinsics of the flag, four numbers or a calibration file."""
    try:
        fx, fy, cx, cy = (float(number) for number in config.intrinsics.strip("[]").split(","))
    except ValueError:
        with flagged("--intrinsics"):
            camera = read_intrinsics(config.intrinsics, config.camera, (height, width))
        if (camera.height, camera.width) != (height, width):
            raise CalibrationError(
                f"--intrinsics: {config.intrinsics} is of images of {camera.width} x {camera.height} pixels, "
                f"these have {width} x {height}"
            ) from None
        if camera.lens is None:
            return Intrinsics(camera.intrinsics, depth_sensor=camera.depth_sensor)
        if camera.lens.model == EQUIDISTANT:
            return Intrinsics(camera.intrinsics, fisheye=camera.lens, depth_sensor=camera.depth_sensor)
        return Intrinsics(camera.intrinsics, np.array(camera.lens.coefficients), depth_sensor=camera.depth_sensor)
    return Intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))


def _reported(intrinsics: EstimatedIntrinsics) -> EstimatedIntrinsics:
    matrix = intrinsics.matrix
    for name, error in intrinsics.errors_px.items():
        logger.info("%s: reprojection error %.2f px", name, error)
    logger.info(
        "intrinsics from %d images: fx %.1f, fy %.1f (± %.2f %%), cx %.1f, cy %.1f, distortion %s",
        len(intrinsics.errors_px),
        matrix[0, 0],
        matrix[1, 1],
        100 * intrinsics.uncertainty,
        matrix[0, 2],
        matrix[1, 2],
        ", ".join(f"{value:.3g}" for value in intrinsics.distortion),
    )
    return intrinsics

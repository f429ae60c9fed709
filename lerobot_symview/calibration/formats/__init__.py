"""Calibration files of other tools, recognised by their content. Each parser returns what its file says, no more."""

from __future__ import annotations

from lerobot_symview.calibration.formats import kalibr, opencv, poses, ros, sensors, simulators
from lerobot_symview.calibration.formats.document import Document
from lerobot_symview.calibration.formats.facts import CameraFacts, Facts, Format, Size
from lerobot_symview.errors import CalibrationError

FORMATS: dict[str, Format] = {
    "opencv_file_storage": opencv.FILE_STORAGE_FORMAT,
    "camera_info": ros.CAMERA_INFO,
    "easy_handeye2": ros.EASY_HANDEYE2,
    "easy_handeye": ros.EASY_HANDEYE,
    "ros_transform": ros.TRANSFORM,
    "kalibr": kalibr.CAMCHAIN,
    "umi": opencv.UMI,
    "realsense": sensors.REALSENSE,
    "orbbec": sensors.ORBBEC,
    "azure_kinect": sensors.AZURE_KINECT,
    "zed": sensors.ZED,
    "bop": simulators.BOP,
    "simulator": simulators.SIMULATED,
    "lerobot_motors": simulators.LEROBOT_MOTORS,
    "droid": poses.DROID,
    "camera_to_world": poses.CAMERA_TO_WORLD,
    "pos_quat": poses.POS_QUAT,
    "rotation_translation": poses.ROTATION_TRANSLATION,
    "array": poses.ARRAY,
    "camera_matrix": opencv.PLAIN,
}
"""Name -> format; the first that recognises a document reads it."""


def recognise(document: Document) -> Format | None:
    """Return the format of a document; None if it has none of `FORMATS`."""
    return next((known for known in FORMATS.values() if known.recognises(document)), None)


def parse(document: Document, known: Format, size: Size | None = None) -> Facts:
    """Return what a document of a known format says of cameras, by name.

    Args:
        document: the file.
        known: its format.
        size: rows and columns of the image, for files with intrinsics of several sizes.

    Raises:
        CalibrationError: if its content is not what the format prescribes.
    """
    import cv2

    try:
        facts = known.parse(document, size)
    except CalibrationError as error:
        raise CalibrationError(f"{known.title}: {error}") from None
    except KeyError as error:
        raise CalibrationError(f"{known.title}: it lacks {error.args[0]}") from None
    except (TypeError, ValueError, AttributeError, IndexError, cv2.error, SystemError) as error:
        raise CalibrationError(f"{known.title}: malformed: {error}") from None
    if not facts:
        raise CalibrationError(f"{known.title}: it has no camera")
    return facts


__all__ = ["FORMATS", "CameraFacts", "Document", "Facts", "Format", "parse", "recognise"]

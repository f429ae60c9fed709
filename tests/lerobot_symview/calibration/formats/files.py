"""Calibration files of every format, written by its own conventions from a known camera, apart from the parsers.

The camera stands beside the table and has neither equal focal lengths nor a centred principal point. Its pose is given
to the writers as the rotation and translation of base_from_camera, with optical axes and in metres.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from lerobot_symview.geometry.camera import Camera, orbit_pose
from lerobot_symview.geometry.workspace import Workspace

HEIGHT, WIDTH = 720, 1280
FX, FY, CX, CY = 631.54, 630.2, 638.43, 366.49
LENS = [0.09, -0.18, 0.0005, -0.0003, 0.06]
LENS_OF_FOUR = [-0.12, 0.03, 0.0005, -0.0003]  # two radial coefficients, which grow up to the corners of the image
WORKSPACE = Workspace(center=(0.45, 0.05), size=0.4)
CAMERA = Camera(
    np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]),
    orbit_pose(np.deg2rad(50), np.deg2rad(25), 0.9, [0.44, 0.03, 0.02]),
    HEIGHT,
    WIDTH,
)
R, T = CAMERA.world_from_cam[:3, :3], CAMERA.world_from_cam[:3, 3]
K = CAMERA.intrinsics
BASE_FROM_CAMERA = np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]])
CAMERA_FROM_BASE = np.linalg.inv(BASE_FROM_CAMERA)
OPTICAL_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
X, Y, Z, W = Rotation.from_matrix(R).as_quat()


def matrix(values) -> dict:
    rows, columns = np.shape(values)
    return {"rows": rows, "cols": columns, "data": np.ravel(values).tolist()}


def camera_info(**changes) -> str:
    return yaml.safe_dump(
        {
            "image_width": WIDTH,
            "image_height": HEIGHT,
            "camera_name": "narrow_stereo",
            "camera_matrix": matrix(K),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": matrix([LENS]),
            "rectification_matrix": matrix(np.eye(3)),
            "projection_matrix": matrix(np.eye(3, 4)),
        }
        | changes
    )


def camera_info_message() -> str:
    flat = {"height": HEIGHT, "width": WIDTH, "distortion_model": "equidistant", "d": [0.1, 0.02, -0.003, 0.0004]}
    return yaml.safe_dump(flat | {"k": K.ravel().tolist(), "r": [0.0] * 9, "p": [0.0] * 12})


def handeye2(frame="camera_color_optical_frame", axes=None, **changes) -> str:
    x, y, z, w = Rotation.from_matrix(R if axes is None else R @ axes).as_quat().tolist()
    parameters = {"name": "a", "calibration_type": "eye_on_base", "robot_base_frame": "b", "tracking_base_frame": frame}
    translation = dict(zip("xyz", T.tolist(), strict=True))
    transform = {"translation": translation, "rotation": {"x": x, "y": y, "z": z, "w": w}}
    return yaml.safe_dump({"parameters": parameters | changes, "transform": transform})


def handeye(**changes) -> str:
    pose = {"x": T[0], "y": T[1], "z": T[2], "qw": W, "qx": X, "qy": Y, "qz": Z}
    parameters = {"eye_on_hand": False, "tracking_base_frame": "camera_optical_frame"} | changes
    transformation = {name: float(value) for name, value in pose.items()}
    return yaml.safe_dump({"parameters": parameters, "transformation": transformation})


def ros_transform() -> str:
    """Of the inverse: the camera is the parent."""
    rotation = Rotation.from_matrix(CAMERA_FROM_BASE[:3, :3]).as_quat().tolist()
    values = {"translation": CAMERA_FROM_BASE[:3, 3].tolist(), "rotation": rotation}
    frames = {"parent_frame": "cam_optical_frame", "child_frame": "base_link"}
    return yaml.safe_dump({"/**": {"ros__parameters": values | frames}})


def file_storage(extension: str) -> str:
    storage = cv2.FileStorage(extension, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", WIDTH)
    storage.write("image_height", HEIGHT)
    storage.write("K", K)
    storage.write("D", np.array([LENS]))
    storage.write("base_T_cam", BASE_FROM_CAMERA)
    return storage.releaseAndGetString()


def kalibr(**changes) -> str:
    camera = {
        "camera_model": "pinhole",
        "intrinsics": [FX, FY, CX, CY],
        "distortion_model": "radtan",
        "distortion_coeffs": LENS_OF_FOUR,
        "resolution": [WIDTH, HEIGHT],
        "T_cam_imu": np.eye(4).tolist(),
    }
    return yaml.safe_dump({"cam0": camera | changes})


def umi() -> str:
    values = {"focal_length": FX, "aspect_ratio": FY / FX, "principal_pt_x": CX, "principal_pt_y": CY, "skew": 0.0}
    values |= {f"radial_distortion_{number}": value for number, value in enumerate([0.1, 0.02, -0.003, 0.0004], 1)}
    size = {"image_height": HEIGHT, "image_width": WIDTH}
    return json.dumps({**size, "intrinsic_type": "FISHEYE", "intrinsics": values, "final_reproj_error": 0.2})


def realsense(**changes) -> str:
    values = {"width": WIDTH, "height": HEIGHT, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY}
    return json.dumps(values | {"model": "distortion.brown_conrady", "coeffs": LENS} | changes)


def orbbec(**more) -> str:
    intrinsic = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True)) | {"k4": 0, "k5": 0, "k6": 0}
    small = {"intrinsic": {name: value / 2 for name, value in intrinsic.items()}, "distortion": lens}
    depth_to_color = {"rotation": np.eye(3).ravel().tolist(), "translation": [-32.1, 0.5, 1.5]}
    blocks = {"640x360": small, f"{WIDTH}x{HEIGHT}": {"intrinsic": intrinsic, "distortion": lens}}
    return json.dumps(blocks | {"depth_to_color": depth_to_color} | more)


def azure_kinect() -> str:
    """K is normalised by the image of 1280 x 960, of which 1280 x 720 are the middle rows; pixel centres at 0.5."""
    k1, k2, p1, p2, k3 = LENS
    full = 960
    normalised = [(CX + 0.5) / WIDTH, (CY + 0.5 + 120) / full, FX / WIDTH, FY / full]
    parameters = [*normalised, k1, k2, k3, 0.01, 0.02, 0.03, 0, 0, p2, p1]
    intrinsics = {"ModelParameters": parameters, "ModelType": "CALIBRATION_LensDistortionModelBrownConrady"}
    color = {"Location": "CALIBRATION_CameraLocationPV0", "Purpose": "CALIBRATION_CameraPurposePhotoVideo"}
    depth = {"Location": "CALIBRATION_CameraLocationD0", "Purpose": "CALIBRATION_CameraPurposeDepth"}
    size = {"SensorWidth": 4096, "SensorHeight": 3072}
    cameras = [{**depth, "Intrinsics": {}}, {**color, **size, "Intrinsics": intrinsics}]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}})


def zed() -> str:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    lines = [f"{name}={value}" for name, value in zip(names, [FX, FY, CX, CY, *LENS], strict=True)]
    sections = ("LEFT_CAM_HD", "LEFT_CAM_VGA", "RIGHT_CAM_HD")
    return "\n".join(["[STEREO]", "Baseline=119.9", *(f"[{name}]\n" + "\n".join(lines) for name in sections)])


def bop() -> str:
    image = {
        "cam_K": K.ravel().tolist(),
        "depth_scale": 0.1,
        "cam_R_w2c": CAMERA_FROM_BASE[:3, :3].ravel().tolist(),
        "cam_t_w2c": (1000 * CAMERA_FROM_BASE[:3, 3]).tolist(),
    }
    return json.dumps({"0": image, "1": image})


def mujoco() -> str:
    fovy = np.rad2deg(2 * np.arctan(HEIGHT / 2 / FY))
    axes = (R @ OPTICAL_FROM_OPENGL).ravel().tolist()
    return json.dumps({"cam_fovy": fovy, "cam_xpos": T.tolist(), "cam_xmat": axes})


def maniskill(**changes) -> str:
    corner = K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # pixel centres at 0.5
    return json.dumps({"extrinsic_cv": [CAMERA_FROM_BASE[:3].tolist()], "intrinsic_cv": [corner.tolist()]} | changes)


def maniskill_npz() -> bytes:
    stream, pose = io.BytesIO(), BASE_FROM_CAMERA.copy()
    pose[:3, :3] = R @ OPTICAL_FROM_OPENGL
    np.savez(stream, cam2world_gl=pose[None].astype(np.float32))
    return stream.getvalue()


def droid() -> str:
    pose = [*T, *Rotation.from_matrix(R).as_euler("xyz")]
    return json.dumps({"12345678_left": {"pose": pose, "timestamp": 1.68e9}})


def camera_to_world() -> str:
    intrinsics = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT}
    stale = np.eye(4).tolist()
    values = {"transform_camera_to_world": BASE_FROM_CAMERA.tolist(), "transform_camera_to_world_prerefine": stale}
    return json.dumps({"244222075350": values | {"intrinsics": intrinsics}})


def pos_quat() -> str:
    """Order w, x, y, z and ROS link axes, neither of which the file says."""
    link = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])  # optical_from_link
    x, y, z, w = Rotation.from_matrix(R @ link).as_quat()
    return json.dumps({"camera0": {"base_frame_id": "base", "pos": T.tolist(), "quat": [w, x, y, z]}})


def rotation_translation() -> str:
    values = {"rotation_matrix": CAMERA_FROM_BASE[:3, :3].tolist()}
    return json.dumps(values | {"translation_vector": (1000 * CAMERA_FROM_BASE[:3, 3:]).tolist()})


def savetxt(value, **options) -> str:
    stream = io.StringIO()
    np.savetxt(stream, value, **options)
    return stream.getvalue()


def save(value) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


def camera_matrix() -> str:
    size = {"image_height": HEIGHT, "image_width": WIDTH}
    rvec = Rotation.from_matrix(CAMERA_FROM_BASE[:3, :3]).as_rotvec().reshape(3, 1).tolist()
    pose = {"rvec": rvec, "tvec": CAMERA_FROM_BASE[:3, 3:].tolist()}
    return json.dumps({"camera_matrix": K.tolist(), "dist_coeffs": [LENS], **size, **pose})


def lerobot_motors() -> str:
    motor = {"id": 1, "drive_mode": 0, "homing_offset": -120, "range_min": 700, "range_max": 3000}
    return json.dumps({"shoulder_pan": motor, "gripper": motor})


FILES: dict[str, dict[str, Callable[[], str | bytes]]] = {
    "opencv_file_storage": {
        "yaml": lambda: file_storage(".yaml"),
        "xml": lambda: file_storage(".xml"),
        "json": lambda: file_storage(".json"),
    },
    "camera_info": {"file": camera_info, "message": camera_info_message},
    "easy_handeye2": {
        "optical": handeye2,
        "link": lambda: handeye2("camera_link", np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])),
    },
    "easy_handeye": {"optical": handeye},
    "ros_transform": {"inverse": ros_transform},
    "kalibr": {"radtan": kalibr},
    "umi": {"fisheye": umi},
    "realsense": {"brown conrady": realsense},
    "orbbec": {"two sizes": orbbec},
    "azure_kinect": {"color": azure_kinect},
    "zed": {"conf": zed},
    "bop": {"two images": bop},
    "simulator": {"mujoco": mujoco, "maniskill": maniskill, "npz": maniskill_npz},
    "lerobot_motors": {"json": lerobot_motors},
    "droid": {"json": droid},
    "camera_to_world": {"json": camera_to_world},
    "pos_quat": {"json": pos_quat},
    "rotation_translation": {"json": rotation_translation},
    "array": {
        "savetxt": lambda: savetxt(BASE_FROM_CAMERA),
        "comma": lambda: savetxt(CAMERA_FROM_BASE[:3], delimiter=",", header="cam_from_base"),
        "json": lambda: json.dumps(BASE_FROM_CAMERA.tolist()),
        "npy": lambda: save(BASE_FROM_CAMERA),
        "K": lambda: savetxt(K),
    },
    "camera_matrix": {"json": camera_matrix},
}
"""Name of a format -> variants of a file of it."""

VARIANTS = [(name, variant) for name, variants in FILES.items() for variant in variants]

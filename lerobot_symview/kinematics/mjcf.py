"""Reads the frames of an MJCF, by MuJoCo; its bodies and sites are frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lerobot_symview.errors import KinematicsError
from lerobot_symview.kinematics.chain import Edge, FrameTree
from lerobot_symview.kinematics.model import Array


def read_mjcf(file: Path) -> FrameTree:
    """Return the frames of an MJCF.

    Raises:
        KinematicsError: if MuJoCo cannot read the file, or a joint is neither a hinge nor a slide.
    """
    import mujoco

    if not file.is_file():
        raise KinematicsError(f"cannot read {file}: there is no such file")
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise KinematicsError(f"{file}: {' '.join(str(error).split())}") from None
    edges: list[Edge] = []
    for index in range(1, model.nbody):
        body = model.body(index)
        parent, pose = model.body(body.parentid[0]).name, _pose(body.pos, body.quat)
        first = int(body.jntadr[0])
        for number in range(first, first + int(body.jntnum[0])):
            joint = model.joint(number)
            kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
            if int(joint.type[0]) not in kinds:
                if body.parentid[0] == 0:  # an object of the scene, not the arm
                    continue
                raise KinematicsError(f"{file}: the joint {joint.name!r} is neither a hinge nor a slide")
            # a joint stands anywhere in its body: to its place, and back
            place, moved = _pose(joint.pos, [1, 0, 0, 0]), f"{body.name}/{joint.name}"
            lower, upper = joint.range if model.jnt_limited[number] else (-np.inf, np.inf)
            kind = kinds[int(joint.type[0])]
            axis = np.array(joint.axis)
            edges.append(Edge(parent, moved, joint.name, kind, pose @ place, axis, float(lower), float(upper)))  # type: ignore[arg-type]
            parent, pose = moved, _pose(-joint.pos, [1, 0, 0, 0])
        edges.append(Edge(parent, body.name, f"{body.name}/fixed", "fixed", pose, np.array([1.0, 0, 0])))
    for index in range(model.nsite):
        site = model.site(index)
        owner = model.body(int(model.site_bodyid[index])).name
        if site.name and site.name not in {edge.child for edge in edges}:
            pose = _pose(site.pos, site.quat)
            edges.append(Edge(owner, site.name, f"{site.name}/fixed", "fixed", pose, np.array([1.0, 0, 0])))
    return FrameTree(tuple(edges))


def _pose(position: Array, quaternion_wxyz: Array | list[int]) -> Array:
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    w, x, y, z = quaternion_wxyz
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = position
    return pose

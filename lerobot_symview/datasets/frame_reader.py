"""Reader of the frames that views are rendered from, in a LeRobot dataset on disk."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, repeat
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, check_origin, parse_calibration
from lerobot_symview.datasets.features import check_depth_size, gripper_dimensions, is_depth_feature, names_of
from lerobot_symview.datasets.source import EpisodeTables, SourceDataset, vectors
from lerobot_symview.errors import CalibrationError, DatasetError
from lerobot_symview.geometry.camera import Camera, aligned_depth, stored_camera
from lerobot_symview.geometry.gripper_state import poses_from_states
from lerobot_symview.geometry.state_reader import StateOrigin, StateReader, origin_of
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, View, other_cameras


@dataclass(frozen=True)
class FrameReader:
    """Reader of one camera's frames, and of the cameras that views merge with it.

    Args:
        dataset: the dataset.
        camera: name of the camera.
        workspace: the square on the table that views show.
        views: the views to render; they determine whether depth, the gripper's state and further cameras are read.
        calibration: calibration of the camera, and of further ones, if it is not in the dataset.
        depth_units: camera -> metres per unit of its depth; by default what the dataset declares, or its values
            suggest.
        state_origin: what the state's positions count from; by default as `origin_of` says.
    """

    dataset: SourceDataset
    camera: str
    workspace: Workspace
    views: Collection[View]
    calibration: Calibration | None = None
    depth_units: Mapping[str, float] = field(default_factory=dict)
    state_origin: StateOrigin | None = None

    @property
    def others(self) -> dict[str, FrameReader]:
        """The readers of the cameras that views merge with this one, by name."""
        readers = {}
        for name in other_cameras(self.views, self.camera):
            alone: list[Any] = [replace(view, cameras=()) for view in self.views if name in view.cameras]
            readers[name] = replace(self, camera=name, views=alone)
        return readers

    @property
    def depth_unit(self) -> float | None:
        """Metres per unit of the camera's depth; None if it is what the dataset declares, or its values suggest."""
        return self.depth_units.get(self.camera)

    @property
    def given_camera(self) -> Camera | None:
        """The camera by `calibration`; None if its calibration is in the dataset alone.

        Raises:
            CalibrationError: if it is in neither.
        """
        if self.calibration is None:
            return None
        is_stored = keys.intrinsics(self.camera) in self.dataset.features
        if is_stored and self.camera not in self.calibration.cameras:
            return None
        return self.calibration.camera(self.camera)

    def given_cameras(self) -> dict[str, Camera]:
        """Return the cameras whose calibration is by `calibration`, of this one and those merged with it, by name."""
        cameras = {reader.camera: reader.given_camera for reader in (self, *self.others.values())}
        return {name: camera for name, camera in cameras.items() if camera is not None}

    @property
    def depth(self) -> bool:
        """Whether a view needs depth."""
        return any(view.needs_depth for view in self.views)

    @property
    def gripper(self) -> bool:
        """Whether a view uses the gripper's state and the dataset has it."""
        is_used = any(view.uses_gripper for view in self.views)
        return is_used and gripper_dimensions(self.dataset.features, self.state_reader.read_names) is not None

    @cached_property
    def states_calibration(self) -> Calibration | None:
        """The calibration file by which states are read: the given one, or that of earlier views."""
        stored = self.dataset.added_views.get("calibration")
        return self.calibration or (parse_calibration(stored) if stored else None)

    @cached_property
    def state_reader(self) -> StateReader:
        """What reads the dataset's states."""
        names, calibration = names_of(self.dataset.features, keys.STATE), self.states_calibration
        kind = self.state_origin or self.dataset.added_views.get("state_origin")
        if calibration is not None:
            check_origin(calibration, kind, names)
        height = calibration.origin_height if calibration else 0.0
        return StateReader(tuple(names), origin_of(kind, names, self.workspace, height))

    def features(self) -> list[str]:
        """Return the keys of the features that `frames` requires."""
        required = self._own_features()
        for other in self.others.values():
            required += other.features()
        return list(dict.fromkeys(required))

    def _own_features(self) -> list[str]:
        required = [keys.rgb(self.camera), "timestamp"]
        required += [keys.depth(self.camera)] if self.depth else []
        required += [keys.STATE] if self.gripper else []
        if self.given_camera is None:
            required += self._calibration()
        return required

    def _calibration(self) -> list[str]:
        """Return the keys of the stored calibration."""
        return keys.calibration(self.camera, self.dataset.features)

    def _has_depth_sensor(self) -> bool:
        """Return whether depth has a calibration of its own, and thus a size and place of its own."""
        camera = self.given_camera
        if camera is None:
            return keys.depth_intrinsics(self.camera) in self._calibration()
        return camera.depth_sensor is not None

    def columns(self) -> list[str]:
        """Return the table columns that `frames` reads: its features except videos."""
        return [key for key in self.features() if not self._is_video(key)]

    def _is_video(self, key: str) -> bool:
        return bool(self.dataset.features.get(key, {}).get("dtype") == "video")

    def check(self) -> None:
        """Raise a DatasetError that lists the required features that the dataset lacks."""
        features = self.dataset.features
        missing = [key for key in self._own_features() if key not in features and not self._is_video(key)]
        depth = keys.depth(self.camera)
        if self.depth and depth in features and not is_depth_feature(features[depth]):
            missing.append(f"{depth} as a depth feature")
        if self.depth and depth not in missing and depth in features and not self._has_depth_sensor():
            check_depth_size(self.camera, features[depth]["shape"], features[keys.rgb(self.camera)]["shape"])
        if missing:
            cameras = sorted(key.split(".")[2] for key in features if key.endswith(".intrinsics"))
            raise DatasetError(
                f"the dataset lacks {', '.join(missing)}; cameras with calibration: {', '.join(cameras) or 'none'}"
            )
        for other in self.others.values():
            other.check()

    def frames(self, episode: int, table: pa.Table) -> Iterator[Frame]:
        """Yield the frames of an episode; `table` holds its rows.

        Raises:
            CalibrationError: if a frame's calibration is invalid.
        """
        others = {name: reader.frames(episode, table) for name, reader in self.others.items()}
        for frame in self._own_frames(episode, table):
            yield replace(frame, others={name: next(frames) for name, frames in others.items()}) if others else frame

    def _own_frames(self, episode: int, table: pa.Table) -> Iterator[Frame]:
        colors = self.dataset.images(keys.rgb(self.camera), episode, table)
        depths: Iterator[Any] = repeat(None)
        if self.depth:
            depths = self.dataset.images(keys.depth(self.camera), episode, table, self.depth_unit)
        states: Iterator[Any] = repeat(None)
        if self.gripper:
            reader = self.state_reader
            pose = gripper_dimensions(self.dataset.features, reader.read_names)
            assert pose is not None
            states = iter(poses_from_states(reader.read(vectors(table, keys.STATE)), pose))
        calibrations: Iterator[Any] = repeat(None)
        if self.given_camera is None:
            names = [keys.parameter(key) for key in self._calibration()]
            columns = zip(*(vectors(table, key) for key in self._calibration()), strict=True)
            calibrations = (dict(zip(names, numbers, strict=True)) for numbers in columns)
        steps = zip(colors, depths, states, calibrations, strict=False)
        for index, (rgb, depth, state, stored) in enumerate(islice(steps, len(table))):
            try:
                camera = self._camera(stored, *rgb.shape[:2])
                aligned = None if depth is None else aligned_depth(depth, camera)
            except CalibrationError as error:
                raise CalibrationError(f"episode {episode}, frame {index}, camera {self.camera!r}: {error}") from None
            yield Frame(rgb, aligned, camera, self.workspace, state)

    def frame(self, episode: int, index: int) -> Frame:
        """Return one frame of an episode, counted from its start."""
        file = self.dataset.data_file(episode)
        table = EpisodeTables(self.dataset, file, self.columns()).read(episode)
        return next(self.frames(episode, table.slice(index, 1)))

    def _camera(self, stored: dict[str, NDArray] | None, height: int, width: int) -> Camera:
        if stored is not None:
            return stored_camera(height=height, width=width, **stored)
        camera = self.given_camera
        assert camera is not None
        if (camera.height, camera.width) != (height, width):
            raise CalibrationError(
                f"the calibration is for {camera.height} x {camera.width} pixels, the images have {height} x {width}"
            )
        return camera

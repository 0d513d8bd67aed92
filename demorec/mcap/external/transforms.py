"""The coordinate frames of a collected episode whose robot is described: its links, and the cameras that they carry."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.external import EpisodeInfo, Feature, SampledFrame, Vector
from demorec.mcap.streams import transforms_layout
from demorec.mcap.transforms import RERUN_ROOT, WORLD, MovingJoints, Row, camera_frame
from demorec.robots.urdf import Urdf


class JointPositions:
    """Which elements of the observations are the positions of which joints.

    Attributes:
        joints: Their names, each once.
    """

    def __init__(self, features: Sequence[Feature]) -> None:
        places: dict[str, tuple[str, int, float]] = {}
        for feature in features:
            if feature.name.partition(".")[0] != "observation":
                continue
            units = feature.units or ("",) * len(feature.names)
            for index, (joint, unit) in enumerate(zip(feature.joints, units, strict=False)):
                if joint:
                    factor = math.radians(1.0) if unit == "deg" else 1.0
                    places.setdefault(joint, (feature.name, index, factor))
        self.joints = tuple(places)
        self._places = tuple(places.values())

    def of(self, features: Mapping[str, Vector]) -> Array:
        """(..., n) rad or m, from features (..., D)."""
        columns = [features[name][..., index] * factor for name, index, factor in self._places]
        return np.stack(columns, axis=-1).astype(np.float64)


class ExternalTree:
    """Which coordinate frames hang on which; a joint of the URDF that is not observed stays at 0.

    Attributes:
        static: Rows that never change.
        is_moving: Whether any joint is known to move.
    """

    def __init__(self, info: EpisodeInfo) -> None:
        urdf = Urdf.parse(info.urdf)
        self._positions = JointPositions(info.features)
        self._joints = MovingJoints(urdf, self._positions.joints)
        self._layout = transforms_layout(self._joints.moving)
        self.is_moving = bool(self._joints.moving)
        self.static: tuple[Row, ...] = (
            (RERUN_ROOT, WORLD, Pose()),
            (WORLD, urdf.root, Pose()),
            *self._joints.static,
            *(
                (camera.mount or urdf.root, camera_frame(camera.name), camera.mount_from_camera)
                for camera in info.cameras
                if camera.mount_from_camera is not None
            ),
        )

    def encode(self, frames: Sequence[SampledFrame]) -> list[bytes]:
        """tf2_msgs/TFMessage of each frame, at its time."""
        names = frames[0].samples
        features = {name: np.array([frame.samples[name].vector for frame in frames]) for name in names}
        values = self._joints.values(self._positions.of(features))
        times = np.array([frame.time_ns for frame in frames], dtype=np.int64)
        return self._layout.encode(times, values.reshape(len(frames), -1))

"""What of an HDF5 file becomes what of an episode: the user's own words, from a TOML file (docs/import.md).

[episodes]
group = "data"                        every group in there is an episode; without, the file is one

[[features."observation.state"]]
dataset = "obs/robot0_joint_pos"      below the episode's group
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from demorec.sources.mapping_file import ACTION, MAX_FPS, AnyMapping, Part, camera_name_problems, feature_problems


@dataclass(frozen=True, kw_only=True)
class DatasetPart(Part):
    """A part of a feature: numbers of one dataset. Attributes as of `Part`, and:

    Attributes:
        dataset: Where they are, below the episode's group: (T, D) or (T,).
    """

    dataset: str = ""


@dataclass(frozen=True, kw_only=True)
class CameraDataset:
    """A camera's pictures.

    Attributes:
        dataset: Where they are, below the episode's group: (T, H, W, 3) or (T, 3, H, W), uint8 or floats from 0 to 1 or
            to 255; or a JPEG file in each row, (T, N) uint8 padded with zeros or (T,) of variable length; of a depth
            camera (T, H, W) or (T, H, W, 1), uint16 mm or float32 m.
        colors: Order of the colours; in JPEG files it is red first by the format itself, but OpenCV writes them of
            pixels that it takes to have blue first.
    """

    dataset: str
    colors: Literal["rgb", "bgr"] = "rgb"


@dataclass(frozen=True, kw_only=True)
class Hdf5Robot:
    """Which robot it was.

    Attributes:
        name: Free to choose; all datasets that shall be merged need the same.
        urdf: File of its model, relative to the mapping's.
        urdf_attribute: Of the episode, which holds its model.
    """

    name: str
    urdf: str = ""
    urdf_attribute: str = ""


@dataclass(frozen=True, kw_only=True)
class Hdf5Task:
    """What the robot was asked to do; one of the three.

    Attributes:
        text: The same for all episodes.
        attribute: Of the episode's group, or of one above it; "ep_meta.lang" is the value `lang` of the JSON in
            `ep_meta`.
        file_name: Take the file's name, "stack_the_cups_003" being "stack the cups".
    """

    text: str = ""
    attribute: str = ""
    file_name: bool = False


@dataclass(frozen=True, kw_only=True)
class Hdf5Clock:
    """When rows were.

    Attributes:
        fps: Rows a second (auto: as the file's attributes say, where they do).
    """

    fps: int | None = None


@dataclass(frozen=True, kw_only=True)
class Hdf5Episodes:
    """Where the episodes are.

    Attributes:
        group: Of which every group is an episode; "" where the file itself is one.
        mask: Only those that the dataset of that name in `mask` lists.
        success: An attribute of the episode that says whether it is one, or a dataset whose last row is above 0 then.
    """

    group: str = ""
    mask: str = ""
    success: str = ""


@dataclass(frozen=True, kw_only=True)
class Hdf5Mapping(AnyMapping):
    """A whole mapping.

    Attributes:
        robot, task, clock, episodes: As described there.
        features: Name of a feature -> its parts, in order.
        cameras: Name of a camera -> its pictures.
        leave_out: Datasets, or groups of them, whose pictures shall not be imported.
    """

    robot: Hdf5Robot
    task: Hdf5Task
    clock: Hdf5Clock = field(default_factory=Hdf5Clock)
    episodes: Hdf5Episodes = field(default_factory=Hdf5Episodes)
    features: Mapping[str, tuple[DatasetPart, ...]]
    cameras: Mapping[str, CameraDataset] = field(default_factory=dict)
    leave_out: tuple[str, ...] = ()

    def leaves_out(self, dataset: str) -> bool:
        """Whether it says that a dataset, or a group that holds it, shall not be imported."""
        return any(f"{dataset}/".startswith(f"{name.strip('/')}/") for name in self.leave_out)

    @property
    def datasets(self) -> frozenset[str]:
        """All that it names below an episode's group."""
        parts = {part.dataset for parts in self.features.values() for part in parts}
        named = parts | {camera.dataset for camera in self.cameras.values()} | {self.episodes.success}
        return frozenset(name.strip("/") for name in named)

    def problems(self) -> Iterator[str]:
        """What is impossible in it, whatever the file."""
        yield from feature_problems(self.features)
        for name, parts in self.features.items():
            if any(bool(part.dataset) == bool(part.next) for part in parts):
                yield f"the feature {name!r} needs either a dataset or next in each of its parts"
        if ACTION not in self.features:
            yield "there is no feature 'action': name its dataset, or next = \"observation.state\""
        yield from camera_name_problems(self.cameras)
        for name in sorted(filter(self.leaves_out, self.datasets)):
            yield f"leave_out leaves out {name!r}, which the mapping names"
        task = self.task
        if (bool(task.text.strip()) + bool(task.attribute) + task.file_name) != 1:
            yield "[task] needs one of text, attribute and file_name"
        if self.clock.fps is not None and not 1 <= self.clock.fps <= MAX_FPS:
            yield f"clock.fps is {self.clock.fps}, allowed are 1 to {MAX_FPS}"
        if not self.robot.name.strip():
            yield "robot.name is empty"
        if self.robot.urdf and self.robot.urdf_attribute:
            yield "robot.urdf and robot.urdf_attribute are both given, one is enough"
        if self.episodes.mask and not self.episodes.group:
            yield "episodes.mask chooses among the episodes of a group, but episodes.group is empty"

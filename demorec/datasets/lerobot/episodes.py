"""The episodes of a LeRobot dataset, whoever wrote it, as recordings give theirs.

    dataset = LeRobotDataset(root)
    for number in range(len(dataset)):
        recording = DatasetRecording(dataset, number)
        recording.info, recording.table(), recording.packets("front"), recording.subtasks

Formats v3.0, v2.1 and v2.0 are read. What our own exports keep beside the tables (outcome, robot, cameras) is used
where it is there. Memory is that of an episode's numbers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.datasets.lerobot.boxes import BOXES_DIR
from demorec.datasets.lerobot.depth import DepthScale
from demorec.datasets.lerobot.files import column_numbers, open_table, table_batches, tables_in
from demorec.datasets.lerobot.language import COLUMNS, PERSISTENT
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature
from demorec.datasets.lerobot.modality import dataset_roles
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import EpisodePlace, EpisodeRows, OpenDataset, RowStream
from demorec.datasets.lerobot.robots import DatasetRobot, read_robot
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA
from demorec.datasets.lerobot.videos import EpisodeVideo, StoredImages, codec_of, opened_video
from demorec.episode.element_names import numbers
from demorec.episode.features import IMAGE_PREFIX
from demorec.episode.info import Camera, Feature, Kept
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.mcap.video import Rgb
from demorec.robots.motors import Motors

_MAX_ELEMENTS = 4096
_RECORDED: Mapping[str, Literal["float32", "float64"]] = {
    **dict.fromkeys(("bool", "int8", "uint8", "int16", "uint16", "float16", "float32"), "float32"),
    **dict.fromkeys(("int32", "uint32", "int64", "uint64", "float64"), "float64"),
}
"""Type of a column -> the type that holds all its numbers, of the largest integers only those up to `_EXACT`."""
_EXACT = 2**53
"""Up to which float64 holds every whole number."""
_KNOWN = ("episode_index", "source", "success", "failure_reason", "root_seed", "cameras", "robot_digest")
"""What is taken from the sidecar for a recording; the rest is of simulated episodes alone."""
_NO_PLACE = "imported recordings hold none"
_SUCCESS, _DONE, _REWARD = "next.success", "next.done", "next.reward"
_NEXT: Mapping[str, str] = {
    _SUCCESS: "its last value becomes the outcome of the episode",
    _DONE: "an export writes it anew, true in the last row of an episode",
    _REWARD: "imported recordings hold an outcome, and no rewards",
}
"""Columns of LeRobot's environments -> what becomes of them."""


class LeRobotDataset(OpenDataset):
    """A dataset whose episodes are read as recordings are.

    Attributes:
        features: What its recordings have of numbers.
        keys: Camera, as recordings call it -> feature.
        left_out: What no recording can hold, by its name in the dataset -> why.
        motors: The servos whose values its state and actions are, where the user says so.
        roles: The role of each feature; one that no name says is also in `features`.

    Raises:
        ExportError: As `OpenDataset`.
        ConfigError: Two cameras would get one name, it has no state of the servos, or lacks what the user names.
    """

    def __init__(self, root: Path, motors: Motors | None = None, named: NamedRoles = NO_NAMES) -> None:
        super().__init__(root)
        self.motors = motors
        self.roles = dataset_roles(root, self.info, named)
        roles = self.roles.beyond_names()
        if motors is not None and self.roles.elements(self.roles.state) != motors.names:
            raise ConfigError(
                f"The dataset has no state of the servos {', '.join(motors.names)}: leave --motor-units out: {root}"
            )
        self.features: tuple[Feature, ...] = ()
        self.keys: dict[str, str] = {}
        self.left_out: dict[str, str] = {}
        for name, feature in self.info.features.items():
            if reason := _why_left_out(name, feature):
                self.left_out[name] = reason
            elif feature.dtype in ("video", "image"):
                # "top" for "observation.images.top", "image" for "observation.image".
                camera = name.removeprefix(IMAGE_PREFIX).removeprefix("observation.").replace(".", "_")
                if camera in self.keys:
                    raise ConfigError(f"Two cameras of the dataset would be called {camera!r}: {root}")
                self.keys[camera] = name
            elif name not in AUTOMATIC_FEATURES:
                vector = _feature(name, feature, self.roles.columns[name].elements)
                self.features += (replace(vector, role=roles.get(name, "")),)
        self.left_out |= dict(self._left_out_beside())
        self._cameras: dict[str, Camera] = {}
        self._videos: dict[tuple[str, int], EpisodeVideo] = {}
        self._stored: dict[str, StoredImages] = {}
        self._robots: dict[str, DatasetRobot] = {}

    def __len__(self) -> int:
        return len(self.places)

    def _left_out_beside(self) -> Iterator[tuple[str, str]]:
        """What stands beside the tables, and is not read."""
        if self.language_stream is not None:
            self.left_out.pop(PERSISTENT)
        for place in (BOXES_DIR, "sarm_progress.parquet"):
            if (self.root / place).exists():
                yield place, _NO_PLACE
        if not self.has_one_robot:
            yield f"{SIDECAR_DIR}/robots", "not all episodes have the same robot there, as those of a run have"
        if any(row["root_seed"] is not None for row in self.known.values()):
            yield f"{SIDECAR_DIR}/episodes", "scenes, phases and conditions of success are not read back"

    def leave_out(self, feature: str, reason: str) -> None:
        """Let no recording have a feature; before the first one is asked for."""
        self.features = tuple(found for found in self.features if found.name != feature)
        self.left_out[feature] = reason

    def inexact(self) -> Iterator[str]:
        """Features of whole numbers that float64 cannot hold all of; ExportError when they cannot be read."""
        for feature in self.features:
            if self.info.features[feature.name].dtype in ("int64", "uint64") and not self._is_exact(feature.name):
                yield feature.name

    def _is_exact(self, name: str) -> bool:
        for path in tables_in(self.root, "data"):
            try:
                for batch in table_batches(path, [name], rows=4096):
                    numbers = column_numbers(batch.column(name))
                    if ((numbers > _EXACT) | (numbers < -_EXACT)).any():
                        return False
            except (ValueError, TypeError, pa.ArrowException) as error:
                raise ExportError(f"The column {name} cannot be read ({describe_error(error)}): {path}") from error
        return True

    @cached_property
    def rows(self) -> RowStream:
        """Of the features, of times, tasks and outcomes."""
        names = [*(feature.name for feature in self.features), "timestamp", "task_index"]
        names += [name for name in (_SUCCESS, "episode_index") if name in self.info.features]
        return RowStream(self.info, names)

    @cached_property
    def language_stream(self) -> RowStream | None:
        """The language columns; None in a dataset without them."""
        spoken = {name for name, feature in self.info.features.items() if feature.dtype == "language"}
        return RowStream(self.info, COLUMNS) if spoken >= set(COLUMNS) else None

    @cached_property
    def known(self) -> Mapping[int, dict[str, Any]]:
        """Episode -> what the sidecar says of it, as far as recordings can hold it; empty without a sidecar."""
        found: dict[int, dict[str, Any]] = {}
        for path in tables_in(self.root, f"{SIDECAR_DIR}/episodes"):
            schema = open_table(path).schema_arrow
            names = [name for name in _KNOWN if name in schema.names]
            for name in names:
                if schema.field(name).type != EPISODE_SCHEMA.field(name).type:
                    raise ExportError(f"The column {name} of the sidecar is {schema.field(name).type}: {path}")
            for batch in table_batches(path, names):
                for row in batch.to_pylist():
                    found[row["episode_index"]] = {**dict.fromkeys(_KNOWN), **row}
        return found

    @cached_property
    def has_one_robot(self) -> bool:
        """Whether the sidecar describes the same robot for all episodes, or none for any."""
        return len({self.known.get(place.episode_index, {}).get("robot_digest") for place in self.places}) <= 1

    def sidecar_rows(self, table: str, episode_index: int) -> list[dict[str, Any]]:
        """All that a table of the sidecar has of an episode; ExportError when it cannot be read."""
        found = EpisodeRows(tables_in(self.root, f"{SIDECAR_DIR}/{table}"), rows=64).read(episode_index)
        return [] if found is None else found.to_pylist()

    def camera(self, name: str) -> Camera:
        """A camera, as the head of its first file or image says, for all episodes."""
        if name not in self._cameras:
            self._cameras[name] = self._look_at(name, self.keys[name])
        return self._cameras[name]

    def _look_at(self, name: str, key: str) -> Camera:
        feature, place = self.info.features[key], self.places[0]
        kept: Kept = ""
        if feature.is_depth:
            (height, width), kept = feature.shape[:2], "32FC1"
        elif feature.is_video:
            with opened_video(self.video(key, place).path) as (_, stream):
                kept, width, height = codec_of(stream), stream.codec_context.width, stream.codec_context.height
        else:
            height, width = next(StoredImages(self.info, key).read(place)).shape[:2]
        return Camera(name=name, width=width, height=height, kept=kept, source=key)

    def robot(self, digest: str) -> DatasetRobot:
        """The arm that episodes call by this digest; ExportError when it cannot be used."""
        if digest not in self._robots:
            self._robots[digest] = read_robot(self.root, digest)
        return self._robots[digest]

    def video(self, key: str, place: EpisodePlace) -> EpisodeVideo:
        """The images of a video feature in an episode."""
        found = self._videos.get((key, place.episode_index))
        if found is None:
            found = self._videos[key, place.episode_index] = EpisodeVideo(self.info, key, place)
        return found

    def stored_images(self, key: str, place: EpisodePlace, frames: Collection[int] | None = None) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of some frames of an episode, of all by default, of an image feature."""
        if key not in self._stored:
            self._stored[key] = StoredImages(self.info, key)
        return self._stored[key].read(place, frames)


def _why_left_out(name: str, feature: DatasetFeature) -> str:
    """Why a feature is in no recording, "" for one that is."""
    if name in AUTOMATIC_FEATURES:
        return ""
    if name.startswith("next."):
        return _NEXT.get(name, _NO_PLACE)
    if feature.is_depth:
        return _why_no_distances(feature)
    if feature.dtype in ("video", "image"):
        return ""
    if feature.dtype not in _RECORDED:
        return f"it is {feature.dtype}, and recordings of other robots hold numbers"
    if feature.shape[0] > _MAX_ELEMENTS:
        return f"it has {feature.shape[0]:,} numbers a row, and recordings of other robots hold up to {_MAX_ELEMENTS:,}"
    if len(feature.shape) > 1:
        return f"it is an array of {'x'.join(map(str, feature.shape))}, and recordings of other robots hold vectors"
    return ""


def _why_no_distances(feature: DatasetFeature) -> str:
    """Why the distances of a depth feature cannot be read, "" when they can."""
    if not feature.is_video:
        return "its depth is in images, and depth is read from videos"
    try:
        DepthScale.of(feature.info or {})
    except ValueError as error:
        return str(error)
    return ""


def _feature(name: str, feature: DatasetFeature, elements: Sequence[str]) -> Feature:
    count = int(np.prod(feature.shape))
    names = tuple(name.replace(",", " ") for name in elements)
    if len(set(names)) != count:
        names = numbers(count)
    return Feature(name=name, dtype=_RECORDED[feature.dtype], names=names, source=name)

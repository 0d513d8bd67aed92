"""A LeRobot dataset of format v2.0 to v3.0 from any writer.

    folder = LeRobotFolder(root)
    rows = folder.rows(["observation.state", "action"])
    for place in folder.places:
        rows.numbers(place)["action"]
        folder.video("observation.images.front", place).images()

Files are opened on demand, so that a missing or damaged one affects only its episodes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.datasets.lerobot.files import open_table, read_json, read_table, tables_in
from demorec.datasets.lerobot.language import COLUMNS
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, STATS_PATH, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH, SIDECAR_DIR
from demorec.episode.roles import NO_NAMES, NamedRoles, Roles
from demorec.extensions.datasets.episode_places import (
    REPAIR,
    EpisodePlace,
    has_episode_table,
    places_by_rows,
    read_episode_table,
    read_tasks,
    relocated,
    rows_by_file,
)
from demorec.extensions.datasets.rows import OWN_COUNTERS, DataRows, EpisodeTable, StoredImages

# Code for videos, images, robots and the sidecar takes longer to load than most datasets' numbers to read.
if TYPE_CHECKING:
    from demorec.datasets.lerobot.robots import DatasetRobot
    from demorec.episode.info import Camera, Feature, Kept
    from demorec.extensions.datasets.videos import EpisodeVideo, VideoFile
    from demorec.robots.motors import Motors

_MAX_LISTED = 50
"""Maximum episodes listed in a sentence."""
_MAX_OPEN_VIDEOS = 16
"""Maximum video files with a cached index; an index of 15 minutes takes 1 MB."""
_LEROBOT_COLUMN = re.compile(
    r"(episode_index|tasks|length|dataset_from_index|dataset_to_index)$|(stats|videos|data|meta)/"
)
_BY_ROWS = f"they were found by the episode_index of the rows ({REPAIR} writes the table again)."
_KNOWN = ("source", "success", "failure_reason", "root_seed", "cameras", "robot_digest")
"""Columns of the sidecar that external recordings can hold; the rest is for simulated episodes only."""


class LeRobotFolder:
    """An open dataset.

    Args:
        root: The dataset's folder.
        motors: Servos whose values are its state and action, if the user names them.
        named: Features whose role the user names.
        info: Replaces the content of meta/info.json.

    Attributes:
        own_counters: Columns that verify the episode of a row, if the files have them.
        keeps_timestamps: Whether edits keep timestamps that are not multiples of 1/fps.
        keeps_statistics: Whether edits keep the stored statistics of images.
        camera: Describes a camera from its first readable file or image.
        robot: Reads the arm with a digest.

    Raises:
        ConfigError: The dataset has no state from these servos.
        ExportError: info.json is missing or damaged. Methods and properties raise it for other unreadable files.
    """

    def __init__(
        self, root: Path, motors: Motors | None = None, named: NamedRoles = NO_NAMES, *, info: DatasetInfo | None = None
    ) -> None:
        self.root, self.motors, self._named = root, motors, named
        self.info = DatasetInfo.load(root) if info is None else info
        self.own_counters: tuple[str, ...] = OWN_COUNTERS
        self.keeps_timestamps = True
        self.keeps_statistics = True
        if motors is not None and self.roles.elements(self.roles.state) != motors.names:
            raise ConfigError(
                f"The dataset has no state of the servos {', '.join(motors.names)}: leave --motor-units out: {root}"
            )
        self.open_video = lru_cache(maxsize=_MAX_OPEN_VIDEOS)(self._video_file)
        self.camera = cache(self._camera)
        self.robot = cache(self._robot)

    def _video_file(self, path: Path) -> VideoFile:
        from demorec.extensions.datasets.videos import VideoFile

        return VideoFile(path, self.info.fps)

    @cached_property
    def roles(self) -> Roles:
        """The role of each feature. Raises ConfigError if the dataset lacks one that the user names."""
        from demorec.extensions.datasets.dataset_features import dataset_roles

        return dataset_roles(self.root, self.info, self._named)

    @cached_property
    def listed(self) -> tuple[EpisodePlace, ...]:
        """Episodes in the episodes' table, or located by the rows if it is missing or names other files."""
        return self._listed_and_problem[0]

    @property
    def is_found_by_rows(self) -> bool:
        """Whether the table of episodes is missing or wrong, so that the episodes were located by their rows."""
        return self._listed_and_problem[1] != ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about missing parts that the rows replace; empty if the rows cannot be read."""
        try:
            listed, problem = self._listed_and_problem
            data = next((place.data for place in listed if place.data.exists()), None)
            columns = AUTOMATIC_FEATURES if data is None else open_table(data).schema_arrow.names
        except ExportError:
            return ()
        absent = ", ".join(name for name in AUTOMATIC_FEATURES if name not in columns)
        missing = f"The rows have no {absent}, and are taken in their order ({REPAIR} adds it)." if absent else ""
        names = ", ".join(name for name in self.info.unlisted if name in columns)
        unlisted = f"{INFO_PATH} does not list {names} of the rows ({REPAIR} adds it)." if names else ""
        return (*(note for note in (problem, missing, unlisted) if note), *self._short_videos, *self._measurements)

    @cached_property
    def _short_videos(self) -> tuple[str, ...]:
        from demorec.extensions.datasets.mp4_index import mp4_index

        notes: list[str] = []
        for key in self.info.video_keys:
            files: dict[Path, list[EpisodePlace]] = {}
            for place in self.listed:
                files.setdefault(place.videos[key][0], []).append(place)
            for path, places in files.items():
                num_rows = max(place.videos[key][1] + place.length for place in places)
                with suppress(ExportError):  # an unreadable file is reported for its own episodes
                    if len(places) > 1 and (num_images := len(mp4_index(path)[0])) < num_rows:
                        numbers = [place.episode_index for place in places]
                        notes.append(
                            f"{path.relative_to(self.root).as_posix()} has {num_images} images for {num_rows} rows of "
                            f"episodes {min(numbers)} to {max(numbers)}: after the first missing image, rows show "
                            "images of other moments."
                        )
        return tuple(notes)

    @cached_property
    def _measurements(self) -> tuple[str, ...]:
        """Sentences about cameras whose video holds a measurement of unknown scale instead of colour."""
        from demorec.mcap.video import deep_gray

        notes: list[str] = []
        for key in self.info.video_keys:
            path = next((place.videos[key][0] for place in self.listed if place.videos[key][0].exists()), None)
            if path is None or self.info.features[key].is_depth:
                continue
            with suppress(ExportError):  # an unreadable file is reported for its own episodes
                file = self.open_video(path)
                if measurement := deep_gray(file.codec, file.pixels, file.parameters):
                    notes.append(f"The video of {key} holds {measurement}: depth or another measurement, not colour.")
        return tuple(notes)

    @cached_property
    def _listed_and_problem(self) -> tuple[tuple[EpisodePlace, ...], str]:
        if has_episode_table(self.root, self.info):
            listed = tuple(read_episode_table(self.root, self.info))
            with suppress(ExportError):  # an unreadable file is reported for its own episodes
                if not self.info.is_old and (found := relocated(self.root, listed)) is not None:
                    moved = sum(a.data != b.data for a, b in zip(listed, found, strict=True))
                    return found, f"The table of episodes names wrong data files for {moved} of them: {_BY_ROWS}"
            return listed, ""
        found = places_by_rows(self.root, self.info, self.tasks) if tables_in(self.root, "data") else ()
        return found, f"The dataset has no table of episodes: {_BY_ROWS}" if found else ""

    @property
    def missing(self) -> str:
        """Difference between info.json and the episodes' table, as a sentence; "" if they agree."""
        counted = int(self.info.total_episodes), int(self.info.total_frames)
        listed = len(self.listed), sum(place.length for place in self.listed)
        if counted == listed:
            return ""
        return (
            f"The dataset is incomplete: {INFO_PATH} counts {counted[0]} episodes of {counted[1]} frames, its table of "
            f"episodes has {listed[0]} of {listed[1]}. Complete the recording or the download, or let {REPAIR} keep "
            f"the intact part: {self.root}"
        )

    @cached_property
    def places(self) -> tuple[EpisodePlace, ...]:
        """All episodes, in order. Raises ExportError if their number differs from info.json."""
        if missing := self.missing:
            raise ExportError(missing)
        return self.listed

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions in the order of their indices."""
        return read_tasks(self.root)

    @cached_property
    def statistics(self) -> Mapping[str, Any]:
        """Content of meta/stats.json, an object for each feature."""
        path = self.root / STATS_PATH
        try:
            found = read_json(path)
            if not isinstance(found, dict) or not all(isinstance(entry, dict) for entry in found.values()):
                raise ValueError("it is not an object of objects")
        except (OSError, ValueError) as error:
            raise ExportError(f"The statistics cannot be read ({describe_error(error)}): {path}") from error
        return found

    @cached_property
    def num_rows(self) -> Mapping[Path, int]:
        """Data file -> number of its episodes' rows."""
        return rows_by_file(self.listed)

    def rows(self, names: Sequence[str]) -> DataRows:
        """Read some columns of the data files."""
        return DataRows(self.info, self.num_rows, names, task_number=self._only_task_number, own=self.own_counters)

    def _only_task_number(self, place: EpisodePlace) -> int:
        if len(place.tasks) != 1 or place.tasks[0] not in self.tasks:
            raise ExportError(
                f"The rows of episode {place.episode_index} have no task_index, and it has {len(place.tasks)} tasks in "
                f"the table of episodes: {place.data}"
            )
        return self.tasks.index(place.tasks[0])

    @cached_property
    def data_tables(self) -> list[Path]:
        """The data files, in order."""
        return tables_in(self.root, "data")

    @cached_property
    def episode_tables(self) -> list[Path]:
        """The files of the table of episodes, in order; none before v3.0."""
        return [] if self.info.is_old else tables_in(self.root, "meta/episodes")

    @property
    def columns(self) -> list[str]:
        """Features that are stored in the data files."""
        return [name for name, feature in self.info.features.items() if not feature.is_video]

    def video(self, key: str, place: EpisodePlace) -> EpisodeVideo:
        """Open the images of a video feature in an episode. Raises ExportError if it has no file."""
        from demorec.extensions.datasets.videos import EpisodeVideo

        if not (path := place.videos[key][0]).exists():
            without = [other for other in self.listed if not other.videos[key][0].exists()]
            numbers = ",".join(str(other.episode_index) for other in without[:_MAX_LISTED])
            more = ",..." if len(without) > _MAX_LISTED else ""
            drop = f"drop these episodes (demorec dataset drop DATASET --episodes {numbers}{more} --out NEW), or "
            raise ExportError(
                f"Episode {place.episode_index} has no video of {key}. Restore the file, "
                f"{drop if len(without) < len(self.listed) else ''}leave the camera out (demorec dataset drop-features "
                f"DATASET {key} --out NEW): {path}"
            )
        return EpisodeVideo(self.open_video, key, place, self.info)

    @cached_property
    def stored_images(self) -> Mapping[str, StoredImages]:
        """Feature -> its images, for features stored in the data files."""
        keys = [name for name, feature in self.info.features.items() if feature.dtype == "image"]
        return {key: StoredImages(self.rows([key])) for key in keys}

    @property
    def sidecar_tables(self) -> list[Path]:
        """The files of the sidecar's table of episodes; none without a sidecar."""
        return tables_in(self.root, f"{SIDECAR_DIR}/episodes")

    @cached_property
    def _sidecar_table(self) -> EpisodeTable:
        from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA

        return EpisodeTable(self.sidecar_tables, EPISODE_SCHEMA)

    def sidecar_row(self, episode_index: int) -> dict[str, Any]:
        """Read the sidecar's whole row of an episode; empty if it has none."""
        return self._sidecar_table.row(episode_index)

    def sidecar(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """Read columns of the sidecar's row of every episode, None if a table lacks one; empty without a sidecar."""
        from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA

        found: list[dict[str, Any]] = []
        for path in self.sidecar_tables:
            stored = open_table(path, ["episode_index"]).schema_arrow.names
            there = [name for name in ("episode_index", *names) if name in stored]
            found += [dict.fromkeys(names) | row for row in read_table(path, there, schema=EPISODE_SCHEMA).to_pylist()]
        return found

    @cached_property
    def fact_types(self) -> Mapping[str, pa.DataType]:
        """Columns of the episodes' table beyond LeRobot's own -> their types; empty before v3.0."""
        schema = open_table(self.episode_tables[0]).schema_arrow if self.episode_tables else ()
        return {item.name: item.type for item in schema if not _LEROBOT_COLUMN.match(item.name)}

    @cached_property
    def known(self) -> Mapping[int, dict[str, Any]]:
        """Episode index -> the sidecar's data about it that recordings can hold."""
        return {row["episode_index"]: row for row in self.sidecar(_KNOWN)}

    @cached_property
    def has_one_robot(self) -> bool:
        """Whether the sidecar describes the same robot for all episodes, or none at all."""
        return len({self.known.get(place.episode_index, {}).get("robot_digest") for place in self.places}) <= 1

    def _robot(self, digest: str) -> DatasetRobot:
        from demorec.extensions.datasets.robots import read_robot

        return read_robot(self.root, digest)

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """Numeric features of its recordings."""
        from demorec.extensions.datasets.dataset_features import recorded_feature, why_not_recorded

        roles = self.roles.beyond_names()
        return tuple(
            replace(recorded_feature(name, feature, self.roles.columns[name].elements), role=roles.get(name, ""))
            for name, feature in self.info.features.items()
            if not (feature.is_camera or name in AUTOMATIC_FEATURES or why_not_recorded(name, feature))
        )

    def is_absent(self, key: str) -> bool:
        """Whether all of a camera's video files are missing, as after a download of the tables alone."""
        return not any(place.videos[key][0].exists() for place in self.listed)

    def leave_out_missing_cameras(self) -> tuple[str, ...]:
        """Exclude the cameras without a video in any episode from recordings; return their features."""
        found = tuple(key for key in self.keys.values() if self.info.features[key].is_video and self.is_absent(key))
        self.keys = {name: key for name, key in self.keys.items() if key not in found}
        return found

    def leave_out(self, name: str) -> None:
        """Exclude a feature from recordings."""
        self.features = tuple(feature for feature in self.features if feature.name != name)

    @cached_property
    def keys(self) -> Mapping[str, str]:
        """Camera name in recordings -> feature. Raises ConfigError if two cameras would get the same name."""
        from demorec.extensions.datasets.dataset_features import camera_name, why_not_recorded

        found: dict[str, str] = {}
        for key, feature in self.info.features.items():
            if not feature.is_camera or why_not_recorded(key, feature):
                continue
            if (name := camera_name(key)) in found:
                raise ConfigError(f"Two cameras of the dataset would be called {name!r}: {self.root}")
            found[name] = key
        return found

    def _camera(self, name: str) -> Camera:
        from demorec.episode.info import Camera

        key = self.keys[name]
        problem = ExportError(f"The dataset has no image of {key}: {self.root}")
        for number, place in enumerate(self.listed):
            try:
                width, height, kept = self._image_format(key, place)
            except ExportError as error:
                problem = problem if number else error
            else:
                return Camera(name=name, width=width, height=height, kept=kept, source=key)
        raise problem

    def _image_format(self, key: str, place: EpisodePlace) -> tuple[int, int, Kept]:
        feature = self.info.features[key]
        if feature.is_depth:
            height, width = feature.shape[:2]
            return width, height, "32FC1"
        if feature.is_video:
            file = self.open_video(place.videos[key][0])
            return *file.size, file.codec
        first = next(self.stored_images[key].read(place, [0]), None)
        if first is None:
            raise ExportError(f"Episode {place.episode_index} has no image of {key}: {place.data}")
        return first.shape[1], first.shape[0], ""

    @cached_property
    def recorded_rows(self) -> DataRows:
        """Read the columns that recordings need: features, times, tasks and outcomes."""
        names = [*(feature.name for feature in self.features), "timestamp", "task_index"]
        return self.rows([*names, *(name for name in ("next.success",) if name in self.info.features)])

    @cached_property
    def language_rows(self) -> DataRows | None:
        """Read the language columns; None in a dataset without them."""
        spoken = {name for name, feature in self.info.features.items() if feature.dtype == "language"}
        return self.rows(COLUMNS) if spoken >= set(COLUMNS) else None

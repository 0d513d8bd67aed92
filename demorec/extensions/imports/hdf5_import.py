"""Import of HDF5 files in robomimic's or ALOHA's layout to runs: bit-exact numbers, passthrough of JPEG files.

All files are checked before anything is written; then rows and images pass in parts. The same command continues:
existing episodes are not written again."""

from __future__ import annotations

import json
import math
import reprlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import sha256_of
from demorec.episode.episode import Outcome, Table
from demorec.episode.info import EpisodeInfo, SourceFile
from demorec.episode.validity import find_problems
from demorec.extensions.imports.description import imported_info, urdf_text
from demorec.extensions.imports.episode_writer import FramesImport, add_episode
from demorec.extensions.imports.fields import FieldError
from demorec.extensions.imports.hdf5_arrays import StoredCamera, StoredFeature
from demorec.extensions.imports.hdf5_file import ForeignFile, Hdf5Error, Scalar, StoredArray
from demorec.extensions.imports.mapping import MAX_FPS, Episodes, SourceMapping
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.extensions.imports.words import in_natural_order, stated_task
from demorec.extensions.recorder.external_run import differences, open_external_run, planned_episode
from demorec.mcap.streams import frame_times
from demorec.runs.find import expect


def import_hdf5(
    paths: Sequence[Path],
    mapping_path: Path | None,
    out: Path,
    *,
    video: VideoConfig | None = None,
) -> FramesImport:
    """Import HDF5 files to a run, by a mapping; datasets of the first episode that it does not name are left out.

    Args:
        paths: Files, in the order of their episodes.
        mapping_path: Path of the mapping.
        out: The run's folder; a run started with the same files and mapping is continued.
        video: Encoding of images that arrive as pixels.

    Raises:
        ConfigError: The mapping is impossible, the files differ, or the folder holds other files.
        Hdf5Error: A file cannot be read, or does not fit the mapping.
        RecordingError: The disk is full or gone.
    """
    assert mapping_path is not None, "the caller requires it"
    mapping = read_mapping(mapping_path, "hdf5")
    urdf = urdf_text(mapping, mapping_path)
    for path in paths:
        expect(path, "hdf5")
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigError("A file is given twice: name each once.")
    episodes, cameras, left_out = _planned(paths, mapping, urdf)
    with open_external_run(out, recovers=False) as folder:
        missing = [episode for episode in episodes if not folder.has(episode.info)]
        folder.planned = [planned_episode(episode.info.episode_index) for episode in missing]
        for episode in missing:
            with ForeignFile(episode.path) as file, _named(episode.path):
                stored = _Stored(file, episode.place, mapping)
                table = stored.table(episode.info.fps)
                images = {camera.name: camera.images() for camera in stored.cameras}
                settings = video or VideoConfig()
                add_episode(folder, episode.info, table, images, outcome=episode.outcome, video=settings, subtasks={})
    return FramesImport(
        num_episodes=len(episodes),
        num_frames=sum(episode.outcome.num_frames for episode in episodes),
        num_new=len(missing),
        cameras=cameras,
        left_out=left_out,
    )


class _PlannedDemo(NamedTuple):
    """An episode to import, with its location in a file."""

    path: Path
    place: str
    info: EpisodeInfo
    outcome: Outcome


def _planned(
    paths: Sequence[Path], mapping: SourceMapping, urdf: str | None
) -> tuple[list[_PlannedDemo], dict[str, str], dict[str, str]]:
    """Check all files; return their episodes, and `cameras` and `left_out` of `FramesImport`."""
    episodes: list[_PlannedDemo] = []
    cameras: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for path in paths:
        with ForeignFile(path) as file, _named(path):
            source = SourceFile(name=path.name, sha256=sha256_of(path))
            places = episode_places(file, mapping.episodes)
            for place in places:
                stored = _Stored(file, place, mapping)
                info = stored.described(urdf, source, len(episodes))
                first = episodes[0].info if episodes else info
                if different := differences(first, info):
                    name = f"{place} of {path}" if place else str(path)
                    raise ConfigError(f"The episodes differ ({'; '.join(different)}): import {name} into another run.")
                info = replace(info, urdf=first.urdf)  # one text in memory
                episodes.append(_PlannedDemo(path, place, info, stored.outcome()))
                cameras = cameras or {c.name: f"{c.width}x{c.height}, {c.description}" for c in stored.cameras}
                if stored.has_last:
                    left_out["the last observation of each episode"] = "no action follows it"
            left_out = {**_unnamed(file, places[0], mapping), **left_out}
            success = mapping.episodes.success
            if success and all(one.outcome.success is None for one in episodes if one.path == path):
                raise Hdf5Error(f"No episode has an attribute or dataset {success!r} with its outcome: {path}")
    return episodes, cameras, left_out


class _Stored:
    """An episode in an open file; FieldError if its datasets do not fit the mapping."""

    def __init__(self, file: ForeignFile, place: str, mapping: SourceMapping) -> None:
        self._file, self._place, self._mapping = file, place, mapping

        def array(name: str, *, may_be_ragged: bool = False) -> StoredArray:
            return file.array("/".join(filter(None, (place, name.strip("/")))), may_be_ragged=may_be_ragged)

        self.features: list[StoredFeature] = []
        for name, parts in mapping.features.items():
            following = parts[0].next
            used = mapping.features[following] if following else parts
            arrays = [array(part.dataset) for part in used]
            self.features.append(StoredFeature(name, used, arrays, shift=1 if following else 0))
        cameras = {name: array(camera.dataset, may_be_ragged=True) for name, camera in mapping.cameras.items()}
        observed = list(cameras.values())
        others: list[StoredArray] = []
        for feature in self.features:
            arrays = others if not feature.name.startswith("observation.") else observed
            arrays += [] if feature.shift else feature.arrays
        # Observations may have one more row than actions, the result of the last action.
        self.num_rows = num_rows = len((others or observed)[0])
        self.has_last = len(observed[0]) == num_rows + 1
        for arrays, wanted in ((others, num_rows), (observed, num_rows + self.has_last)):
            for one in arrays:
                if len(one) != wanted:
                    raise FieldError(f"{one.place} has {len(one)} rows, other datasets of the episode have {wanted}")
        self.num_frames = min(num_rows, len(observed[0]) - max(feature.shift for feature in self.features))
        if self.num_frames < 1:
            raise FieldError(f"{place or 'the episode'} has {num_rows} rows, too few for a frame")
        self.cameras = [StoredCamera(name, mapping.cameras[name], images) for name, images in cameras.items()]

    def table(self, fps: int) -> Table:
        """Read the numbers of every frame."""
        times = frame_times(self.num_frames, fps)
        features = {feature.name: feature.vectors(self.num_frames) for feature in self.features}
        cameras = [camera.name for camera in self.cameras]
        return Table(
            time_ns=times,
            features=features,
            stamps=dict.fromkeys(features, times),
            images=dict.fromkeys(cameras, np.arange(self.num_frames)),
            image_stamps=dict.fromkeys(cameras, times),
        )

    def described(self, urdf: str | None, source: SourceFile, episode_index: int) -> EpisodeInfo:
        """Describe it for its recording; checks every number."""
        dtypes = [feature.vectors(self.num_frames).dtype for feature in self.features]
        try:
            info = imported_info(
                self._mapping,
                episode_index=episode_index,
                instruction=self._task(),
                urdf=urdf,
                fps=self._rate(),
                features=(one.described(dtype) for one, dtype in zip(self.features, dtypes, strict=True)),
                cameras=(camera.described() for camera in self.cameras),
                files=[source],
            )
        except ValueError as error:
            raise FieldError(str(error)) from error
        if wrong := find_problems(info):
            raise FieldError("; ".join(wrong))
        return info

    def _rate(self) -> int:
        """Rows per second; Hdf5Error if neither the mapping nor the file gives an integer."""
        if self._mapping.clock.fps:
            return self._mapping.clock.fps
        found, path = stated_rate(self._file, self._place), self._file.path
        if found is None:
            raise Hdf5Error(f"The file does not record its rate: give clock.fps in the mapping: {path}")
        if not 1 <= found <= MAX_FPS or found != int(found):
            raise Hdf5Error(
                f"The file has {found:g} rows a second, allowed are whole numbers from 1 to {MAX_FPS}: "
                f"give clock.fps in the mapping: {path}"
            )
        return int(found)

    def _task(self) -> str:
        """Instruction of the task; Hdf5Error if the file does not have it."""
        task, path = self._mapping.task, self._file.path
        if text := stated_task(task, path.stem):
            return text
        found = found_attribute(self._file, self._place, task.attribute)
        if not isinstance(found, str) or not found.strip():
            raise Hdf5Error(
                f"Missing attribute {task.attribute!r} with the task of {self._place or 'the episode'}: {path}"
            )
        return found

    def outcome(self) -> Outcome:
        """Outcome, which is unknown if the mapping does not name its source, or the episode does not have it.

        Raises:
            FieldError: It has an invalid value.
        """
        name = self._mapping.episodes.success.strip("/")
        return Outcome(success=self._success(name) if name else None, num_frames=self.num_frames)

    def _success(self, name: str) -> bool | None:
        file, place = self._file, self._place
        found = file.attribute(place, name)
        if isinstance(found, str) or (isinstance(found, float) and not math.isfinite(found)):
            raise FieldError(
                f"{place or 'the episode'} has {name} = {reprlib.repr(found)}, allowed are booleans and numbers"
            )
        if found is not None or not file.has(f"{place}/{name}"):
            return None if found is None else bool(found)
        array = file.array(f"{place}/{name}".lstrip("/"))
        if len(array) != self.num_rows:
            raise FieldError(f"{array.place} has {len(array)} rows, the episode has {self.num_rows}")
        return bool((array.read(self.num_rows - 1, self.num_rows).astype(np.float64) > 0).all())


def _unnamed(file: ForeignFile, place: str, mapping: SourceMapping) -> dict[str, str]:
    """Datasets that the mapping does not name; groups without any named ones appear as one."""
    used = {name.partition("/")[0] for name in mapping.datasets}
    names = (dataset.removeprefix(place).lstrip("/") for dataset in file.datasets(place))
    others = [name for name in names if name not in mapping.datasets]
    return {name if (group := name.partition("/")[0]) in used else group: "" for name in others}


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Add the file to errors about mismatches."""
    try:
        yield
    except FieldError as error:
        raise Hdf5Error(f"The mapping does not fit the file: {error}: {path}") from error


_RATES = ("fps", "env_args.env_kwargs.fps", "env_args.env_kwargs.control_freq")
"""Attributes with the rows per second: demorec's own, and robosuite's."""


def episode_places(file: ForeignFile, episodes: Episodes) -> list[str]:
    """Groups of the episodes, demo_2 before demo_10.

    Raises:
        Hdf5Error: None exist, or one is a link.
    """
    group = episodes.group.strip("/")
    if not episodes.group:
        return [""]
    kinds = file.children(group)
    names = [name for name, kind in kinds.items() if kind != "dataset"]
    if not names:
        raise Hdf5Error(f"No episodes in {group or 'the root'}: {file.path}")
    if others := [name for name in names if kinds[name] == "other"]:
        raise Hdf5Error(
            f"{_below(group, others[0])} is a link, a type or a second name, only groups within the file are episodes: "
            f"{file.path}"
        )
    return [_below(group, name) for name in sorted(names, key=in_natural_order)]


def _below(group: str, name: str) -> str:
    return f"{group}/{name}" if group else name


def found_attribute(file: ForeignFile, place: str, name: str) -> Scalar | None:
    """An attribute of an episode, or of a group above it; a name with dots continues into the JSON of one."""
    groups = place.split("/")
    for level in ("/".join(groups[:depth]) for depth in range(len(groups), -1, -1)):
        if (found := file.attribute(level, name)) is not None:
            return found
        first, _, keys = name.partition(".")
        text = file.attribute(level, first) if keys else None
        if isinstance(text, str) and (inside := _in_json(text, keys.split("."))) is not None:
            return inside
    return None


def _in_json(text: str, keys: list[str]) -> Scalar | None:
    value = _parsed(text)
    for key in keys:
        if isinstance(value, list):
            value = value[int(key)] if key.isdecimal() and len(key) < 10 and int(key) < len(value) else None
        else:
            value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, str | bool | int | float) else None


@lru_cache(maxsize=4)
def _parsed(text: str) -> Any:
    """Parse JSON, which may apply to a thousand episodes; None if it is invalid."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def stated_rate(file: ForeignFile, place: str) -> float | None:
    """Rate in the file's attributes; None if they have none."""
    for name in _RATES:
        found = found_attribute(file, place, name)
        if isinstance(found, int | float) and not isinstance(found, bool):
            return float(found) if abs(found) <= sys.float_info.max else math.inf
    return None

"""Checks of a LeRobot dataset that demorec wrote, against its sidecar and against the recordings of its run."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Checkable, Fault, NotApplicableError, check, listed
from demorec.check.run import CheckedRun
from demorec.core.errors import ConfigError, DemorecError, RecordingError, describe_error, resource_error
from demorec.core.plain import from_plain
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import content_digest, noted, recorded_info, usable_numbers, video_digests
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import is_dataset
from demorec.datasets.lerobot.prepare import reasons_to_transcode, recorded_videos
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA, EXPORT_PATH, EpisodeRecord
from demorec.episode.info import EpisodeInfo
from demorec.mcap import open_simulated
from demorec.runs.run_file import DATASET, EPISODES, FAILED

Rows = Mapping[str, NDArray[Any]]
_OF_THE_PLACE = ("episode_index", "source", "content_digest")
"""Sidecar keys that do not come from the recording."""
_DECIDING_OPTIONS = ("action", "state", "privileged", "features", "include_failures", "fps", "depth")
"""Export options that decide the content of the episodes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DescribedEpisode:
    """A simulated episode of a dataset, with its row of the sidecar, `kept`."""

    number: int
    rows: Rows  # feature -> (T, D)
    kept: dict[str, Any]
    info: EpisodeInfo


class CheckedDataset(LeRobotFolder):
    """An open dataset with its rows and its sidecar in memory."""

    @property
    def numbers(self) -> Mapping[int, Rows]:
        """Episode number -> feature -> (T, D), for the episodes with readable rows."""
        return self._rows_and_errors[0]

    @property
    def unreadable(self) -> Mapping[int, str]:
        """Episode number -> reason why its rows cannot be read."""
        return self._rows_and_errors[1]

    @cached_property
    def _rows_and_errors(self) -> tuple[dict[int, Rows], dict[int, str]]:
        reader = self.rows(self.columns)
        rows: dict[int, Rows] = {}
        errors: dict[int, str] = {}
        for number, place in enumerate(self.listed):
            problems: list[str] = []
            with noted(problems, self.root):
                rows[number] = usable_numbers(self, reader, place)
            if problems:
                errors[number] = problems[0]
        return rows, errors

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """The sidecar's rows for the episodes; empty for a dataset of another writer."""
        return episode_records(self)

    def check_simulated(self) -> None:
        """Raise ConfigError for a dataset of external episodes, which cannot be simulated or replayed."""
        if any(row["episode_info"] is None for row in self.records):
            raise ConfigError(
                f"The episodes of this dataset were recorded by another robot or program and have no scene: {self.root}"
            )

    def described(self) -> list[DescribedEpisode]:
        """Simulated episodes that the sidecar describes, in order; LeRobot's `resume` adds episodes without a
        description.
        """
        found = []
        for row in self.records:
            number = row["episode_index"]
            if row["episode_info"] is None or number not in self.numbers:
                continue
            info = recorded_info(row, self.root)
            found.append(DescribedEpisode(number=number, rows=self.numbers[number], kept=row, info=info))
        return sorted(found, key=lambda episode: episode.number)


def episode_records(dataset: LeRobotFolder) -> list[dict[str, Any]]:
    """Read the sidecar's rows for the episodes; empty for a dataset of another writer."""
    return dataset.sidecar([name for name in EPISODE_SCHEMA.names if name != "episode_index"])


@check(
    family="files",
    on=("dataset",),
    needs="demorec's sidecar",
    measures="episodes that differ from their sidecar entry",
    why="The dataset differs from the export.",
    do="export it again",
)
def dataset_sidecar(subject: Checkable) -> Iterator[Fault]:
    """Compare instruction and content digest of each episode, as far as its files can be read, with the sidecar."""
    dataset = LeRobotFolder(subject.path)
    records = episode_records(dataset)
    if not records:
        raise NotApplicableError("another program wrote the dataset")
    count = len(dataset.listed)
    known = [row["episode_index"] for row in records]
    if sorted(set(known)) != known or not set(known) <= set(range(count)):
        return listed([f"its rows have the episodes {reprlib.repr(known)}, the dataset has {count}"])
    missing = sorted(set(range(count)) - set(known))
    wrong = [f"episode {number} is unknown, perhaps recorded with LeRobot's resume" for number in missing]
    reader = dataset.rows(dataset.columns)
    for row in records:
        number, place = row["episode_index"], dataset.listed[row["episode_index"]]
        if row["episode_info"] is not None and place.tasks != (recorded_info(row, dataset.root).instruction,):
            wrong.append(f"episode {number} has another instruction")
            continue
        with noted([], dataset.root):  # other checks report what cannot be read
            if content_digest(dataset, reader, place) != row["content_digest"]:
                wrong.append(f"episode {number} has changed since it was exported")
    return listed(wrong)


@check(
    family="files",
    on=("run",),
    needs="a run of simulated episodes",
    measures="episodes of its dataset that differ from the recordings",
    why="The dataset differs from the run.",
    do="export it again",
)
def run_dataset(run: CheckedRun) -> Iterator[Fault]:
    """Compare every number and encoded image of each episode with its recording, exported with the same options."""
    path = run.path / DATASET
    if not is_dataset(path):
        raise NotApplicableError("the run has no dataset")
    dataset = CheckedDataset(path)
    if not dataset.records or any(row["source"] is None for row in dataset.records):
        return listed(["the dataset does not name its source recordings"])
    dataset.check_simulated()
    options = _export_options(path)
    wrong = list(dict.fromkeys(dataset.unreadable.values()))
    successes = len(run.run.successes)
    found = sum(bool(row["success"]) for row in dataset.records)
    if found != successes:
        wrong.append(f"it has {found} successes, the run {successes}")
    for episode in dataset.described():
        folder = run.path / (EPISODES if episode.kept["success"] else FAILED)
        file = folder / Path(str(episode.kept["source"])).name
        if words := ", ".join(_episode_differences(file, options, episode, dataset)):
            wrong.append(f"episode {episode.number}: {words}")
    return listed(wrong)


def _export_options(dataset: Path) -> ExportOptions:
    """Options with which a dataset was exported, as far as they decide its episodes.

    Raises:
        ConfigError: The dataset does not record them.
    """
    try:
        made = read_json(dataset / EXPORT_PATH)
        options = from_plain({name: made[name] for name in _DECIDING_OPTIONS}, ExportOptions)
        options.validate()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"The dataset does not record its export options ({describe_error(error)}): {dataset}"
        ) from error
    return options


def _episode_differences(
    recording_file: Path, options: ExportOptions, episode: DescribedEpisode, dataset: CheckedDataset
) -> Iterator[str]:
    """Yield the features in which an episode differs from its recording exported with the same options.

    Raises:
        ExportError: A video of the dataset cannot be read.
        ResourceError: This machine cannot read it.
    """
    try:
        with open_simulated(recording_file) as recording:
            expected = ExportEpisode(recording, options)
            columns, record = expected.columns, EpisodeRecord.of(expected)
            # The bytes of re-encoded images depend on the version and machine of the encoder.
            reasons = reasons_to_transcode(expected)
            recorded = recorded_videos(expected, [camera for camera, reason in reasons.items() if not reason])
    except RecordingError as error:
        yield str(error)
        return
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        yield f"its recording cannot be exported as this episode ({describe_error(error)})"
        return
    place = dataset.listed[episode.number]
    if place.tasks != (expected.info.instruction,):
        yield "instruction"
    for name, values in columns.items():
        found = episode.rows.get(name)
        if found is None or not np.array_equal(found, values.reshape(len(values), -1)):
            yield name
    videos = video_digests(dataset, place)
    for key, video in recorded.items():
        if videos.get(key) != video.digest:
            yield key
    for name, value in record.row.items():
        if name not in _OF_THE_PLACE and episode.kept.get(name) != value:
            yield f"sidecar's {name}"

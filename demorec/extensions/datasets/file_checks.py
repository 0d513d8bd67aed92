"""Checks of a LeRobot dataset that demorec wrote, against its sidecar and against the recordings of its run."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Checkable, Fault, NotApplicableError, check, listed
from demorec.check.run import CheckedRun
from demorec.core.errors import ConfigError, DemorecError, RecordingError, describe_error, resource_error
from demorec.core.plain import from_plain
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import is_dataset
from demorec.datasets.lerobot.prepare import reasons_to_transcode, recorded_videos
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA, EXPORT_PATH, EpisodeRecord
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import content_digest, noted, recorded_info, usable_numbers, video_digests
from demorec.extensions.datasets.rows import DataRows
from demorec.mcap import open_simulated
from demorec.runs.run_file import DATASET, EPISODES, FAILED

_OF_THE_PLACE = ("episode_index", "source", "content_digest")
"""Sidecar keys that do not come from the recording."""
_DECIDING_OPTIONS = ("action", "state", "privileged", "features", "include_failures", "depth")
"""Export options that decide the content of the episodes."""


def _episode_records(dataset: LeRobotFolder) -> list[dict[str, Any]]:
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
    records = _episode_records(dataset)
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
    dataset = LeRobotFolder(path)
    records = _episode_records(dataset)
    if not records or any(row["source"] is None for row in records):
        return listed(["the dataset does not name its source recordings"])
    options, reader = _export_options(path), dataset.rows(dataset.columns)
    wrong = []
    successes = len(run.run.successes)
    found = sum(bool(row["success"]) for row in records)
    if found != successes:
        wrong.append(f"it has {found} successes, the run {successes}")
    for row in records:
        file = run.path / (EPISODES if row["success"] else FAILED) / Path(str(row["source"])).name
        problems: list[str] = []
        with noted(problems, path):
            problems += _episode_differences(file, options, row, dataset, reader)
        if problems:
            wrong.append(f"episode {row['episode_index']}: {', '.join(problems)}")
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
    recording_file: Path, options: ExportOptions, kept: Mapping[str, Any], dataset: LeRobotFolder, reader: DataRows
) -> Iterator[str]:
    """Yield the features in which an episode differs from its recording exported with the same options.

    Args:
        recording_file: The recording.
        options: Options of the export.
        kept: The episode's row of the sidecar.
        dataset: The dataset.
        reader: All columns of its tables.

    Raises:
        ExportError: The rows or a video of the episode cannot be read.
        ResourceError: This machine cannot read it.
    """
    place = dataset.listed[kept["episode_index"]]
    rows = usable_numbers(dataset, reader, place)
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
    if place.tasks != (expected.info.instruction,):
        yield "instruction"
    for name, values in columns.items():
        found = rows.get(name)
        if found is None or not np.array_equal(found, values.reshape(len(values), -1)):
            yield name
    videos = video_digests(dataset, place)
    for key, video in recorded.items():
        if videos.get(key) != video.digest:
            yield key
    for name, value in record.row.items():
        if name not in _OF_THE_PLACE and kept.get(name) != value:
            yield f"sidecar's {name}"

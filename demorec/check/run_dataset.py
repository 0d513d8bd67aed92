"""Check the dataset in a run's folder against the recordings that it was exported from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from demorec.check.base import Fault, NotApplicableError, check, listed
from demorec.check.dataset import CheckedDataset, DescribedEpisode
from demorec.check.run import CheckedRun
from demorec.core.errors import ConfigError, DemorecError, RecordingError, describe_error, resource_error
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.inspect import video_digests
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import is_dataset
from demorec.datasets.lerobot.prepare import reasons_to_transcode, recorded_videos
from demorec.datasets.lerobot.sidecar import EXPORT_PATH, EpisodeRecord
from demorec.mcap import open_simulated
from demorec.runs.run_file import DATASET

_OF_THE_PLACE = ("episode_index", "source", "content_digest")
"""Sidecar keys that do not come from the recording."""


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
    options = export_options(path)
    wrong = list(dict.fromkeys(dataset.unreadable.values()))
    successes = len(run.run.successes)
    found = sum(bool(row["success"]) for row in dataset.records)
    if found != successes:
        wrong.append(f"it has {found} successes, the run {successes}")
    for episode in dataset.described():
        folder = run.path / ("episodes" if episode.kept["success"] else "failed")
        file = folder / Path(str(episode.kept["source"])).name
        if words := [what for what, _ in episode_differences(file, options, episode, dataset)]:
            wrong.append(f"episode {episode.number}: {', '.join(words)}")
    return listed(wrong)


def export_options(dataset: Path) -> ExportOptions:
    """Options with which a dataset was exported, as far as they decide its episodes.

    Raises:
        ConfigError: The dataset does not record them.
    """
    try:
        made = read_json(dataset / EXPORT_PATH)
        options = ExportOptions(
            action=made["action"],
            state=made.get("state", "joint"),
            privileged=made["privileged"],
            features=tuple(made.get("features", ())),
            include_failures=made["include_failures"],
            fps=made["fps"],
            depth=made["depth"],
            verify=False,
        )
        options.validate()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"The dataset does not record its export options ({describe_error(error)}): {dataset}"
        ) from error
    return options


def episode_differences(
    recording_file: Path, options: ExportOptions, episode: DescribedEpisode, dataset: CheckedDataset
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield (feature, frames) for each difference between an episode and its recording exported with the same options.

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
        yield str(error), ()
        return
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        yield f"its recording cannot be exported as this episode ({describe_error(error)})", ()
        return
    place = dataset.listed[episode.number]
    if place.tasks != (expected.info.instruction,):
        yield "instruction", ()
    for name, values in columns.items():
        found, true = episode.rows.get(name), values.reshape(len(values), -1)
        if found is None or found.shape != true.shape:
            yield name, ()
        elif len(frames := np.flatnonzero((found != true).any(axis=1))):
            yield name, tuple(frames.tolist())
    videos = video_digests(dataset, place)
    for key, video in recorded.items():
        if videos.get(key) != video.digest:
            yield key, ()
    for name, value in record.row.items():
        if name not in _OF_THE_PLACE and episode.kept.get(name) != value:
            yield f"sidecar's {name}", ()

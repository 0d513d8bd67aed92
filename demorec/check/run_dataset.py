"""Is the dataset in a run's folder that of the run: every episode against the recording that it comes from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Measurement, counted, run_check
from demorec.check.dataset import Dataset, Rows, read_rows
from demorec.check.run import CheckedRun
from demorec.core.errors import ConfigError, DemorecError, RecordingError, describe_error, resource_error
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import SIDECAR_DIR, is_dataset
from demorec.datasets.lerobot.prepare import prepare_episode, reasons_to_transcode
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA, EXPORT_PATH, EpisodeRecord
from demorec.datasets.lerobot.videos import PacketReader
from demorec.mcap import open_recording

_OF_THE_PLACE = ("episode_index", "source", "content_digest")
"""What the sidecar keeps that is not of the recording."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetEpisode:
    """One episode of a dataset that has a sidecar.

    Attributes:
        number: In the dataset.
        rows: Feature -> (T, D).
        videos: Camera feature -> SHA-256 (hex) of its coded images.
        tasks: Instructions.
        details: The sidecar's row.
    """

    number: int
    rows: Rows
    videos: Mapping[str, str]
    tasks: tuple[str, ...]
    details: Mapping[str, Any]


@run_check(measures="episodes of the run's dataset that are not what was recorded")
def run_dataset_content(run: CheckedRun) -> Measurement | None:
    """Every number and coded image of each episode is that of its recording, exported with the same options."""
    path = run.path / "dataset"
    if not is_dataset(path):
        return None
    dataset = Dataset(path)
    if not dataset.sidecar:
        return Measurement(value=1, detail="the dataset does not say which recordings it comes from")
    options = export_options(path)
    wrong: list[str] = []
    for episode in dataset_episodes(dataset):
        file = (
            run.path
            / ("episodes" if episode.details["success"] else "failed")
            / Path(str(episode.details["source"])).name
        )
        if words := [what for what, _ in episode_differences(file, options, episode)]:
            wrong.append(f"episode {episode.number}: {', '.join(words)}")
    return counted(wrong, f"{len(dataset.sidecar)} episodes")


def dataset_episodes(dataset: Dataset) -> Iterator[DatasetEpisode]:
    """Every episode that the sidecar knows, in order; ExportError when a file cannot be read."""
    details = read_rows(dataset.path / SIDECAR_DIR, EPISODE_SCHEMA.names)
    with ExitStack() as stack:
        readers = {key: stack.enter_context(closing(PacketReader(key))) for key in dataset.info.video_keys}
        for row in sorted(details, key=lambda row: int(row["episode_index"])):
            if (number := int(row["episode_index"])) in range(len(dataset.rows)):
                place = dataset.places[number]
                videos = {key: _digest(reader.read(place)) for key, reader in readers.items()}
                rows = dataset.rows[number]
                yield DatasetEpisode(number=number, rows=rows, videos=videos, tasks=place.tasks, details=row)


def _digest(samples: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for sample in samples:
        digest.update(sample)
    return digest.hexdigest()


def export_options(dataset: Path) -> ExportOptions:
    """With which a dataset was made, as far as they decide its episodes.

    Raises:
        ConfigError: It does not say so.
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
            f"The dataset does not say how it was exported ({describe_error(error)}): {dataset}"
        ) from error
    return options


def episode_differences(
    recording_file: Path, options: ExportOptions, episode: DatasetEpisode
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """(what, in which frames) of an episode is not what a recording gives with the same options.

    Raises:
        ResourceError: This machine cannot read it.
    """
    try:
        with open_recording(recording_file, simulated=True) as recording:
            exporting = ExportEpisode(recording, options)
            expected = prepare_episode(exporting, options, encode_depth=False)
            record = EpisodeRecord.of(exporting)
            # Encoded anew, images have the bytes of the version and machine that encoded them.
            transcoded = {camera.feature for camera, reason in reasons_to_transcode(exporting).items() if reason}
    except RecordingError as error:
        yield str(error), ()
        return
    except DemorecError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        yield f"its recording gives no such episode ({describe_error(error)})", ()
        return
    if episode.tasks != (expected.task,):
        yield "instruction", ()
    for name, values in expected.columns.items():
        found, true = episode.rows.get(name), values.reshape(len(values), -1)
        if found is None or found.shape != true.shape:
            yield name, ()
        elif len(frames := np.flatnonzero((found != true).any(axis=1))):
            yield name, tuple(frames.tolist())
    for key, video in expected.videos.items():
        if key not in transcoded and episode.videos.get(key) != video.digest:
            yield key, ()
    for name, value in record.row.items():
        if name not in _OF_THE_PLACE and episode.details.get(name) != value:
            yield f"sidecar's {name}", ()

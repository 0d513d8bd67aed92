"""Recordings to a LeRobot v3.0 dataset: `export_lerobot`, from the first recording to the finished folder."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError, ExportError, MissingDependencyError, describe_error
from demorec.core.processes import available_cores, in_turn
from demorec.core.replacing import shown
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.lerobot.boxes import BoxWriter, SeenByCamera
from demorec.datasets.lerobot.card import has_own_card, write_card
from demorec.datasets.lerobot.existing import Existing, features_to_append, link_files, open_existing
from demorec.datasets.lerobot.facts import STAGE_COLUMNS, fact_types, write_progress
from demorec.datasets.lerobot.inspect import episode_digests
from demorec.datasets.lerobot.layout import CODEBASE_VERSION, DatasetInfo, combined_digest
from demorec.datasets.lerobot.motor_units import NO_PLACE, recording_of
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH, DATASET, GROWING_DATASET
from demorec.datasets.lerobot.prepare import dataset_features, episode_boxes, prepare_episode, reasons_to_transcode
from demorec.datasets.lerobot.sidecar import EpisodeRecord, SidecarWriter, attempt_row
from demorec.datasets.lerobot.verify import LEROBOT, MAX_EPISODES, Verifier, lerobot_is_installed
from demorec.datasets.lerobot.writer import DatasetWriter, EpisodeData
from demorec.datasets.options import ExportReport, ProgressCallback
from demorec.datasets.sources import Intake, find_recordings, goes_in, is_wanted, places_of
from demorec.episode.episode import Outcome

_STATED_OPTIONS = (
    "action", "state", "privileged", "features", "include_failures", "episodes", "fps", "depth", "motor_units", "boxes",
    "progress", "hold_images",
)  # fmt: skip
"""Options that decide what the episodes contain; `demorec/export.json` has them."""


def export_lerobot(
    sources: Sequence[Path], out: Path, options: ExportOptions, progress: ProgressCallback | None = None
) -> ExportReport:
    """Write the recordings into the dataset folder `out`: whole, or not at all.

    Args:
        sources: Recordings, runs, or folders of recordings.
        out: Folder of the dataset.
        options: How.
        progress: Called after every recording.

    Raises:
        ConfigError: Options that contradict each other or ask for what was not recorded, nothing to export, recordings
            that differ, something in the way at `out`, or episodes to be appended that the dataset has already.
        ExportError: A full disk, a failed verification. What was at `out` is still there
            then.
        RecordingError: A recording is damaged.
    """
    options.validate()
    found = find_recordings(sources)
    existing = open_existing(out) if options.append and out.exists() else None
    verifies = options.verify and lerobot_is_installed()
    kind, replace_it = (DATASET, options.overwrite) if existing is None else (GROWING_DATASET, True)
    with (
        atomic_write(out, kind, overwrite=replace_it, sources=places_of(found)) as folder,
        Verifier() if verifies else nullcontext() as verifier,
    ):
        if existing is not None:
            link_files(existing.root, folder)
        elif options.overwrite and has_own_card(out) and (out / CARD_PATH).is_file():
            shutil.copy2(out / CARD_PATH, folder / CARD_PATH)  # what somebody wrote outlives the dataset it was about
        export = _Export(folder, found, options, existing)
        report = export.run(progress)
        if verifier is not None:
            report = replace(report, verified_frames=verifier.verify(folder, export.samples(), options))
    why = f"LeRobot, which would verify the dataset, is not installed: pip install '{LEROBOT}'."
    report = replace(report, path=out, not_verified=why if options.verify and not verifies else "")
    if options.push_to_hub:
        report = replace(report, url=push_to_hub(out, options.repo_id, private=not options.public))
    return report


_ENCODED = ".encoded"
"""Folder next to the new one for images of the export's processes."""


class _Export:
    """One export into an empty (or linked) folder."""

    def __init__(self, folder: Path, found: list[Path], options: ExportOptions, existing: Existing | None) -> None:
        self._folder = folder
        self._found = found
        self._options = options
        self._existing = existing
        self._before = episode_digests(existing.root, existing.info) if existing is not None else []
        self._left_out: tuple[str, ...] = ()
        self._transcoded: dict[str, None] = {}
        self._digests: list[str] = []
        self._recordings: list[Path] = []
        self._silent: list[str] = []
        self._intake = Intake(found, options)

    def run(self, progress: ProgressCallback | None) -> ExportReport:
        aside = self._folder.with_name(_ENCODED)  # removed with everything next to the new folder
        aside.mkdir(exist_ok=True)
        found = self._noted(readings(self._found, self._options, progress, aside=aside))
        begun: list[Reading] = []  # up to the first episode, which decides what features there are
        for reading in found:
            begun.append(reading)
            if reading.data is not None:
                break
        self._intake.check()
        info = self._dataset_info(begun[-1])
        facts, there = self._facts(begun[-1]), self._existing
        with (
            DatasetWriter(
                self._folder, info, facts, there.tasks if there else (), there.statistics if there else {}
            ) as writer,
            SidecarWriter(self._folder, info, there.configs if there else {}) as sidecar,
            BoxWriter(self._folder, fps=info.fps) as boxes,
        ):
            for reading in chain(begun, found):
                self._add(writer, sidecar, reading)
                if reading.data is not None and self._options.boxes:
                    boxes.add(writer.num_episodes - 1, reading.boxes, reading.data.num_frames)
            self._refuse_duplicates()
            self._refuse_silence()
            finished = writer.finish()
            boxes.finish()
            configs = sidecar.finish(self._about_this_export())
        if self._options.progress:
            write_progress(self._folder)
        write_card(self._folder, finished, self._options, configs, is_transcoded=bool(self._transcoded))
        return ExportReport(
            path=self._folder,
            num_episodes=finished.total_episodes,
            num_frames=finished.total_frames,
            new_episodes=finished.total_episodes - info.total_episodes,
            skipped_failures=self._intake.skipped_failures,
            skipped_unknown=self._intake.skipped_unknown,
            skipped_unwanted=self._intake.skipped_unwanted,
            transcoded=tuple(self._transcoded),
            left_out=(*self._left_out, *(NO_PLACE if self._options.motor_units else ())),
            depth_left_out=begun[-1].depth_left_out,
            silent=tuple(self._silent),
            digest=combined_digest(finished, [*self._before, *self._digests]),
        )

    def samples(self) -> list[tuple[int, Path]]:
        """What shall be verified: the new episodes, or some of them, spread evenly, if there are very many."""
        first = self._existing.info.total_episodes if self._existing else 0
        count = len(self._recordings)
        chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_EPISODES)).round().astype(int)).tolist()
        return [(first + index, self._recordings[index]) for index in chosen]

    def _dataset_info(self, first: Reading) -> DatasetInfo:
        if self._existing is not None:
            self._left_out = features_to_append(self._existing, first.info)
            return self._existing.info
        return replace(
            first.info,
            chunks_size=self._options.files_per_chunk,
            data_files_size_in_mb=self._options.data_files_mb,
            video_files_size_in_mb=self._options.video_files_mb,
        )

    def _facts(self, first: Reading) -> Mapping[str, pa.DataType]:
        """The columns of facts that the table of episodes has, or gets from the first episode."""
        if self._existing is None:
            return {} if first.data is None else fact_types(first.data.facts)
        has_progress = set(STAGE_COLUMNS) <= set(self._existing.facts)
        if has_progress != self._options.progress:
            raise ConfigError(
                f"These recordings cannot be appended, since the dataset {'has' if has_progress else 'lacks'} the "
                f"stages of --progress: export {'with' if has_progress else 'without'} it: {self._existing.root}"
            )
        return self._existing.facts

    def _noted(self, found: Iterable[Reading]) -> Iterator[Reading]:
        """The same, each counted and held against the others before it is written."""
        for reading in found:
            if reading.data is None:
                self._intake.leave_out(reading.outcome)
            else:
                self._intake.take(reading.path, reading.traits)
            yield reading

    def _add(self, writer: DatasetWriter, sidecar: SidecarWriter, reading: Reading) -> None:
        if reading.data is None or reading.record is None:
            sidecar.add_attempt(reading.attempt)
            return
        digest = writer.add(reading.data)
        sidecar.add(writer.num_episodes - 1, digest, reading.record, reading.attempt)
        if self._options.language is not None and not reading.is_simulated and not reading.data.language.persistent:
            self._silent.append(reading.path.name)
        self._digests.append(digest)
        self._recordings.append(reading.path)
        self._transcoded.update(dict.fromkeys(reading.transcoded))

    def _refuse_duplicates(self) -> None:
        """Raise ConfigError when new episodes have the content of some that the dataset appended to has already."""
        there = {digest: number for number, digest in enumerate(self._before)}
        pairs = zip(self._recordings, self._digests, strict=True)
        twice = [f"{path.name} (episode {there[digest]} of it)" for path, digest in pairs if digest in there]
        if twice and not self._options.allow_duplicates:
            raise ConfigError(
                f"The dataset has {len(twice)} of these episodes already: {shown(twice)}. Leave them out with "
                "--episodes, or give --allow-duplicates to have them twice."
            )

    def _refuse_silence(self) -> None:
        """Raise ConfigError when language is asked for and nobody said a word in any episode of a new dataset."""
        if self._existing is None and self._options.language is not None and len(self._silent) == len(self._recordings):
            raise ConfigError(
                "Language is asked for, but the episodes are external and no source of them states a subtask (in the "
                "mapping of an import, [subtasks] names the topic of it): leave --language out."
            )

    def _about_this_export(self) -> dict[str, Any]:
        options = {name: getattr(self._options, name) for name in _STATED_OPTIONS}
        return {"demorec": version("demorec"), **options, "language": list(self._options.spoken)}


def push_to_hub(folder: Path, repo_id: str, *, private: bool) -> str:
    """Upload the folder as a dataset repository, tagged with the format's version as LeRobot expects it.

    Returns:
        Its address.

    Raises:
        ExportError: No token, no network, no right to write there; the folder stays as it is.
        MissingDependencyError: The Hub's client, which comes with LeRobot, is not installed.
    """
    try:
        from huggingface_hub import HfApi, get_token
    except ImportError as error:
        raise MissingDependencyError(
            f"Uploading the dataset, which is kept ({folder}),", "huggingface_hub", "pip install huggingface_hub"
        ) from error
    if get_token() is None:
        raise ExportError(
            "The dataset was not uploaded, there is no Hugging Face token: type hf auth login, or set HF_TOKEN, and "
            f"then: hf upload {repo_id} {folder} --repo-type dataset"
        )
    hub = HfApi()
    try:
        url = hub.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True)
        hub.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            repo_type="dataset",
            commit_message="Upload dataset",
        )
        hub.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset", exist_ok=True)
    except Exception as error:  # the hub's client raises errors of several HTTP libraries
        raise ExportError(
            f"The dataset was not uploaded to {repo_id} ({describe_error(error)}); it is kept: {folder}"
        ) from error
    return str(url)


_BYTES_THAT_PAY = 1 << 30
"""Reading is so quick that starting processes pays from about a gigabyte of recordings on (benchmarks/export.py)."""
_AHEAD = 3
"""Recordings that each process may be ahead of the writer: bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """What came of one recording.

    Attributes:
        path: The recording.
        attempt: For the success rates.
        outcome: As recorded; None where the recording ends before it.
        data: The episode; None for a failed attempt that is left out, of which nothing that follows is read, so
            that an export does not fail for what it leaves out.
        record: Of it, for the sidecar.
        boxes: Camera feature -> what it sees, if that was asked for.
        traits: What must agree with all the others.
        info: Of a dataset made from it.
        depth_left_out: Depth cameras that were not asked for.
        transcoded: Cameras whose images had to be encoded anew, with the reason.
        is_simulated: Whether demorec simulated the episode.
    """

    path: Path
    attempt: Mapping[str, Any]
    outcome: Outcome | None
    data: EpisodeData | None = None
    record: EpisodeRecord | None = None
    boxes: Mapping[str, SeenByCamera] = field(default_factory=dict)
    traits: Mapping[str, str] = field(default_factory=dict)
    info: DatasetInfo = field(default_factory=lambda: DatasetInfo(fps=1, features={}))
    depth_left_out: tuple[str, ...] = ()
    transcoded: tuple[str, ...] = ()
    is_simulated: bool = False


def read(path: Path, options: ExportOptions) -> Reading | None:
    """Read one recording; None if its episode is not wanted (`is_wanted`).

    Raises:
        RecordingError: It is damaged.
        ExportError: It has no frames, or its fps is no multiple of the wanted one.
    """
    with recording_of(path, options) as recording:
        if not is_wanted(recording, options):
            return None
        attempt = attempt_row(recording)
        if not goes_in(recording, options):
            return Reading(path=path, attempt=attempt, outcome=recording.outcome)
        episode = ExportEpisode(recording, options)
        reasons = reasons_to_transcode(episode)
        return Reading(
            path=path,
            attempt=attempt,
            outcome=recording.outcome,
            traits=dict(episode.traits()),
            info=DatasetInfo(
                fps=episode.fps,
                features=dataset_features(episode, options),
                robot_type=recording.info.robot_name,
            ),
            depth_left_out=episode.depth_left_out,
            transcoded=tuple(f"{camera.name}, {reason}" for camera, reason in reasons.items() if reason),
            is_simulated=episode.info.simulation is not None,
            data=prepare_episode(episode, options),
            record=EpisodeRecord.of(episode),
            boxes=episode_boxes(episode) if options.boxes else {},
        )


def readings(
    sources: Sequence[Path], options: ExportOptions, progress: ProgressCallback | None, *, aside: Path
) -> Iterator[Reading]:
    """Every wanted recording in order; several processes read ahead where that pays, and leave images in `aside`."""
    workers = options.workers or _workers_that_pay(sources, options)
    one = partial(read, options=options) if workers == 1 else partial(_read_aside, options=options, folder=aside)
    for done, reading in enumerate(in_turn(one, sources, workers, ahead=_AHEAD), start=1):
        if reading is not None:
            yield reading
        if progress is not None:
            progress(done, len(sources))


def _workers_that_pay(sources: Sequence[Path], options: ExportOptions) -> int:
    transcodes = options.depth or options.fps is not None
    size = sum(path.stat().st_size for path in sources) * (20 if transcodes else 1)
    return min(available_cores(), 8) if size >= _BYTES_THAT_PAY else 1


def _read_aside(path: Path, options: ExportOptions, folder: Path) -> Reading | None:
    """`read`, with the images in files: through a pipe they cost as much as all the rest."""
    reading = read(path, options)
    if reading is None or reading.data is None:
        return reading
    videos = {key: video.put_aside(folder) for key, video in reading.data.videos.items()}
    return replace(reading, data=replace(reading.data, videos=videos))

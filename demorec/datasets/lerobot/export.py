"""Export of recordings to a LeRobot v3.0 dataset."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np

from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError, ExportError, MissingDependencyError, describe_error
from demorec.core.processes import available_cores, in_turn
from demorec.core.replacing import shown
from demorec.core.tables import EXTRA_FILES
from demorec.datasets.lerobot.card import has_own_card, write_card
from demorec.datasets.lerobot.existing import features_to_append, link_files, start_after
from demorec.datasets.lerobot.layout import CODEBASE_VERSION, combined_digest
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH, DATASET, GROWING_DATASET
from demorec.datasets.lerobot.prepare import NO_PLACE, ExportedEpisode, export_episode, prepare_episode
from demorec.datasets.lerobot.verify import LEROBOT, MAX_EPISODES, Verifier, lerobot_is_installed
from demorec.datasets.lerobot.writer import DatasetStart, DatasetWriter
from demorec.datasets.options import ExportReport, ProgressCallback
from demorec.datasets.sources import Intake, LeftOut, find_recordings, places_of, why_left_out
from demorec.mcap import open_recording

_STATED_OPTIONS = ("action", "state", "privileged", "features", "include_failures", "episodes", "depth", "motor_units")
"""Options that decide the content of the episodes; `demorec/export.json` lists them."""


def export_lerobot(
    sources: Sequence[Path], out: Path, options: ExportOptions, progress: ProgressCallback | None = None
) -> ExportReport:
    """Write the recordings in files, runs or folders to the dataset folder `out`, completely or not at all.

    Raises:
        ConfigError: Options that contradict each other or ask for data that was not recorded, nothing to export,
            recordings that differ, an existing `out`, or episodes to append that the dataset already has.
        ExportError: A full disk, a failed verification. `out` is unchanged.
        RecordingError: A recording is damaged.
    """
    options.validate()
    found = find_recordings(sources)
    existing = start_after(out) if options.append and out.exists() else None
    export = _Export(found, out, options, existing)
    verifies = options.verify and lerobot_is_installed()
    kind, replace_it = (DATASET, options.overwrite) if existing is None else (GROWING_DATASET, True)
    with (
        atomic_write(out, kind, overwrite=replace_it, sources=places_of(found)) as folder,
        Verifier() if verifies else nullcontext() as verifier,
    ):
        if existing is not None:
            link_files(out, folder)
        elif options.overwrite and has_own_card(out) and (out / CARD_PATH).is_file():
            shutil.copy2(out / CARD_PATH, folder / CARD_PATH)  # keep a card that a user edited
        report = export.run(folder, progress)
        if verifier is not None:
            report = replace(report, verified_frames=verifier.verify(folder, export.samples(), options))
    why = f"LeRobot, which verifies the dataset, is not installed: pip install '{LEROBOT}'."
    report = replace(report, path=out, not_verified=why if options.verify and not verifies else "")
    if options.push_to_hub:
        report = replace(report, url=push_to_hub(out, options.repo_id, private=not options.public))
    return report


_ENCODED = ".encoded"
"""Folder next to the new one for the worker processes' images."""


class _Export:
    def __init__(self, found: list[Path], out: Path, options: ExportOptions, existing: DatasetStart | None) -> None:
        self._found = found
        self._out = out
        self._options = options
        self._existing = existing
        self._before = () if existing is None else existing.digests
        self._left_out: tuple[str, ...] = ()
        self._transcoded: dict[str, None] = {}
        self._digests: dict[Path, str] = {}
        self._has_statements = False
        self._intake = Intake(found, options)

    def run(self, folder: Path, progress: ProgressCallback | None) -> ExportReport:
        """Write all recordings to an empty folder, or to one with links to the existing dataset's files."""
        aside = folder.with_name(_ENCODED)  # removed with all files next to the new folder
        aside.mkdir(exist_ok=True)
        episodes = self._episodes(aside, progress)
        begin = next(episodes, None)
        if begin is None:
            raise self._intake.nothing_to_export()
        _, first = begin  # which decides the features
        extra = {name: EXTRA_FILES.load(name)(folder, first.info.fps) for name in self._options.extra_files}
        with DatasetWriter(folder, self._start(first)) as writer:
            for path, episode in chain([begin], episodes):
                for name, files in extra.items():
                    files.add(episode.extra[name])
                self._digests[path] = writer.add(episode.data)
                self._has_statements |= episode.has_statements
                self._transcoded.update(dict.fromkeys(episode.transcoded))
            self._refuse_duplicates()
            self._refuse_silence()
            stated = {name: getattr(self._options, name) for name in _STATED_OPTIONS}
            stated |= {name: name in extra for name in EXTRA_FILES.names()}
            finished = writer.finish({"demorec": version("demorec"), **stated, "language": list(self._options.spoken)})
        for files in extra.values():
            files.finish()
        write_card(folder, finished, self._options, first.meanings)
        return ExportReport(
            path=folder,
            num_episodes=finished.total_episodes,
            num_frames=finished.total_frames,
            new_episodes=len(self._digests),
            skipped_failures=self._intake.skipped["failures"],
            skipped_unwanted=self._intake.skipped["unwanted"],
            transcoded=tuple(self._transcoded),
            left_out=(*self._left_out, *(NO_PLACE if self._options.motor_units else ())),
            depth_left_out=first.depth_left_out,
            digest=combined_digest(finished, [*self._before, *self._digests.values()]),
        )

    def samples(self) -> list[tuple[int, Path]]:
        """Choose the new episodes to verify: all, or `MAX_EPISODES` of them, evenly spaced."""
        paths = list(self._digests)
        chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), MAX_EPISODES)).round().astype(int)).tolist()
        return [(len(self._before) + index, paths[index]) for index in chosen]

    def _start(self, first: ExportedEpisode) -> DatasetStart:
        if self._existing is None:
            return DatasetStart(info=first.info, configs={})
        self._left_out = features_to_append(self._out, self._existing.info, first.info)
        return self._existing

    def _episodes(self, folder: Path, progress: ProgressCallback | None) -> Iterator[tuple[Path, ExportedEpisode]]:
        """Yield each selected recording and its episode in order; count the others, and compare the traits.

        Several processes read ahead if that saves time. They store the images in `folder`, because sending them through
        a pipe takes as long as the rest of the work.
        """
        paths, options = self._found, self._options
        workers = options.workers or _workers_that_pay(paths, options)
        read = partial(_read, options=options, folder=None if workers == 1 else folder)
        recordings = in_turn(read, paths, workers, ahead=_AHEAD)
        for done, (path, found) in enumerate(zip(paths, recordings, strict=True), start=1):
            if isinstance(found, ExportedEpisode):
                self._intake.take(path, found.traits)
                yield path, found
            else:
                self._intake.leave_out(found)
            if progress is not None:
                progress(done, len(paths))

    def _refuse_duplicates(self) -> None:
        there = {digest: number for number, digest in enumerate(self._before)}
        known = {path: there[digest] for path, digest in self._digests.items() if digest in there}
        twice = [f"{path.name} (its episode {number})" for path, number in known.items()]
        if twice:
            raise ConfigError(
                f"The dataset has {len(twice)} of these episodes already, leave them out (--episodes): {shown(twice)}"
            )

    def _refuse_silence(self) -> None:
        """Raise ConfigError if language is requested and a new dataset would have no statements."""
        if self._existing is None and self._options.language is not None and not self._has_statements:
            raise ConfigError(
                "These episodes have no language, since no source specifies subtasks: leave --language out."
            )


def push_to_hub(folder: Path, repo_id: str, *, private: bool) -> str:
    """Upload the folder as a dataset repository and return its URL, tagged with the format's version. Raises
    ExportError without a token, network, or write permission, and MissingDependencyError without the Hub's client; the
    folder is unchanged.
    """
    try:
        from huggingface_hub import HfApi
    except ImportError as error:
        raise MissingDependencyError(
            f"Uploading the dataset, which is kept ({folder}),", "huggingface_hub", "pip install huggingface_hub"
        ) from error
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
    except Exception as error:  # the Hub's client raises errors of several HTTP libraries
        raise ExportError(
            f"The dataset was not uploaded to {repo_id} ({describe_error(error)}), it is kept. Type hf auth login, or "
            f"set HF_TOKEN, then: hf upload {repo_id} {folder} --repo-type dataset"
        ) from error
    return str(url)


_BYTES_THAT_PAY = 1 << 30
"""Minimum size of the recordings for which several processes save time (benchmarks/export.py)."""
_AHEAD = 3
"""Maximum number of recordings that each process may be ahead of the writer, to limit memory."""


def _read(path: Path, options: ExportOptions, folder: Path | None) -> ExportedEpisode | LeftOut:
    """Read one recording. Only the metadata of one to leave out is read, so its faults do not stop the export."""
    with open_recording(path) as recording:
        if (reason := why_left_out(recording, options)) is not None:
            return reason
        episode = prepare_episode(export_episode(recording, options))
    if folder is not None:
        videos = {key: video.put_aside(folder) for key, video in episode.data.videos.items()}
        episode = replace(episode, data=replace(episode.data, videos=videos))
    return episode


def _workers_that_pay(sources: Sequence[Path], options: ExportOptions) -> int:
    size = sum(path.stat().st_size for path in sources) * (20 if options.depth else 1)
    return min(available_cores(), 8) if size >= _BYTES_THAT_PAY else 1

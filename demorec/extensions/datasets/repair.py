"""Reconstruction of a damaged dataset from its rows. Nothing is invented: data that neither rows nor tables have cannot
be repaired.

Written like any other edit, the result has tables, counters and statistics that fit its rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from demorec.core.errors import ExportError, without_path
from demorec.core.replacing import shown
from demorec.datasets.lerobot.files import column_numbers, open_table
from demorec.datasets.lerobot.paths import is_dataset_file
from demorec.extensions.datasets.corrections import (
    Repaired,
    kept_splits,
    repaired_cameras,
    repaired_features,
    repaired_rate,
    stated_info,
    table_changes,
    usable_info,
)
from demorec.extensions.datasets.episode_places import (
    EpisodePlace,
    EpisodeRun,
    are_on_grid,
    episode_runs,
    has_episode_table,
    images_by_rows,
    placed,
    read_episode_table,
    read_tasks,
)
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.mp4_index import mp4_index
from demorec.extensions.datasets.rows import DataRows

_Images = list[tuple[Path, int] | None]


class RepairedDataset(LeRobotFolder):
    """An open dataset with corrected tables and info.json.

    Args:
        root: The dataset's folder.

    Attributes:
        changes: A sentence for each difference from tables and info.json.
        instructions: Number of an episode -> its instruction, if its rows do not refer to one.
        splits: Those of info.json, empty if they do not fit the episodes.

    Raises:
        ExportError: Data would have to be invented.
    """

    def __init__(self, root: Path) -> None:
        self.changes: list[str] = []
        stated = stated_info(root)
        super().__init__(root, info=usable_info(stated, root))
        self.data_tables = [path for path in self.data_tables if self._is_readable(path)]
        self.episode_tables = [path for path in self.episode_tables if self._is_readable(path)]
        stored = self._stored()
        runs = self._ordered_runs()
        videos = sorted((root / "videos").rglob("*.mp4"))
        self._correct_info(repaired_features(self.info, self.data_tables, videos))
        self._correct_info(repaired_rate(self.info, self.data_tables[0], videos))
        if len({run.episode_index for run in runs}) < len(runs):
            stored, self.episode_tables, self.keeps_statistics = {}, [], False
        kept, images = self._with_images(runs, stored)
        self._correct_info(repaired_cameras(self, images))
        self.num_rows = {path: open_table(path).metadata.num_rows for path in self.data_tables}
        self._count(kept)
        self.instructions: dict[int, str] = {}
        self._set_tasks(kept, stored)
        self.listed = self.places = placed(kept, images, self.tasks)
        self._check_timestamps()
        self.changes += table_changes(self, stated, stored)
        self.splits = kept_splits(self, stated)

    def _correct_info(self, repaired: Repaired) -> None:
        self.info, changes = repaired
        self.changes += changes

    @property
    def notes(self) -> tuple[str, ...]:
        """The changes."""
        return tuple(self.changes)

    def rows(self, names: Sequence[str]) -> DataRows:
        """Read some columns of the data files, if they exist."""
        there = set(open_table(self.data_tables[0]).schema_arrow.names)
        return super().rows([name for name in names if name in there])

    def change(self, sentence: str) -> None:
        """Note a change, once."""
        if sentence not in self.changes:
            self.changes.append(sentence)

    def _is_readable(self, path: Path) -> bool:
        name = path.relative_to(self.root).as_posix()
        try:
            if not is_dataset_file(name):
                raise ExportError("LeRobot gives no file this name")
            open_table(path)
        except ExportError as error:
            self.change(f"{name} is left out: {without_path(error, path)}")
            return False
        return True

    def _stored(self) -> dict[int, EpisodePlace]:
        """Episode index -> location in the table of episodes; empty if the table is unusable."""
        if not has_episode_table(self.root, self.info):
            self.change("The table of episodes is missing: it is written from the rows.")
            return {}
        try:
            return {place.episode_index: place for place in read_episode_table(self.root, self.info)}
        except ExportError as error:
            self.change(f"The table of episodes is written from the rows: {without_path(error, self.root)}")
            return {}

    def _ordered_runs(self) -> list[EpisodeRun]:
        """Find the episodes by the rows of readable files, sorted by number."""
        runs: list[EpisodeRun] = []
        problems: dict[Path, ExportError] = {}
        for path in self.data_tables:
            try:
                runs += episode_runs([path], first=len(runs))
            except ExportError as error:
                problems[path] = error
                self.change(f"{path.relative_to(self.root).as_posix()} is left out: {without_path(error, path)}")
        self.data_tables = [path for path in self.data_tables if path not in problems]
        if not runs:
            raise next(iter(problems.values()), ExportError(f"No data file of the dataset can be read: {self.root}"))
        if len({run.episode_index for run in runs}) == len(runs):
            runs.sort(key=lambda run: run.episode_index)
        for run in runs:
            self._check_frames(run)
        return runs

    def _check_frames(self, run: EpisodeRun) -> None:
        """Note a `frame_index` that does not begin at 0. Raises ExportError if rows in the middle are missing."""
        frames = run.counters.get("frame_index", np.arange(run.length))
        steps = np.flatnonzero(np.diff(frames) != 1)
        if len(steps):
            first = int(steps[0])
            raise ExportError(
                f"Rows of episode {run.episode_index} are missing or exchanged (frame_index {frames[first + 1]} comes "
                f"after {frames[first]}), and it is unknown which: drop it first (demorec dataset drop --episodes "
                f"{run.episode_index}): {run.data}"
            )
        if frames[0] != 0:
            self.own_counters = ("episode_index",)
            self.change("frame_index is counted from 0 in each episode.")

    def _with_images(
        self, runs: Sequence[EpisodeRun], stored: Mapping[int, EpisodePlace]
    ) -> tuple[list[EpisodeRun], dict[str, list[tuple[Path, int]]]]:
        """Find the images of the episodes; leave out episodes with unreadable images."""
        found = {key: self._images(key, runs, stored) for key in self.info.video_keys}
        missing = {n: key for key, images in found.items() for n, image in enumerate(images) if image is None}
        for number, key in missing.items():
            self.change(f"Episode {runs[number].episode_index} is left out: images of {key} are missing or damaged.")
        if len(missing) == len(runs):
            raise ExportError(
                f"No episode has all its images: leave a camera out (demorec dataset drop-features), or restore its "
                f"videos: {self.root}"
            )
        kept = {key: [image for n, image in enumerate(images) if image is not None and n not in missing]
                for key, images in found.items()}  # fmt: skip
        return [run for number, run in enumerate(runs) if number not in missing], kept

    def _images(self, key: str, runs: Sequence[EpisodeRun], stored: Mapping[int, EpisodePlace]) -> _Images:
        """Find the images of a camera by the table if all its entries are possible, otherwise by counting."""
        if self.info.is_old or any(run.episode_index not in stored for run in runs):
            places = images_by_rows(self.root, self.info, key, runs)
        else:
            places = [stored[run.episode_index].videos[key] for run in runs]
        counts = {path: _num_images(path) for path, _ in places}
        ends: dict[Path, int] = {}
        found: _Images = []
        for run, (path, first) in zip(runs, places, strict=True):
            count = counts[path]
            is_possible = first >= ends.get(path, 0) and (count is None or first + run.length <= count)
            is_short = count is not None and count < run.length and sum(other == path for other, _ in places) == 1
            if not is_possible and not is_short:
                self.keeps_statistics = False
                return list(images_by_rows(self.root, self.info, key, runs))
            ends[path] = first + run.length
            found.append((path, first) if is_possible and count is not None else None)
        return found

    def _count(self, runs: Sequence[EpisodeRun]) -> None:
        """Note missing and wrong counters."""
        numbers = [run.episode_index for run in runs]
        if numbers != list(range(len(runs))):
            self.change(f"The episodes are numbered from 0; they were {shown(numbers)}.")
        begin, wrong = 0, 0
        for run in runs:
            rows = np.arange(begin, begin + run.length)
            wrong += not np.array_equal(run.counters.get("index", rows), rows)
            begin += run.length
        if wrong:
            self.change(f"index counts over the whole dataset: it was wrong in {wrong} of {len(runs)} episodes.")

    def _set_tasks(self, runs: Sequence[EpisodeRun], stored: Mapping[int, EpisodePlace]) -> None:
        """Get the instructions from the rows, otherwise from the table of episodes; ExportError if neither has one."""
        try:
            known = {number: task for number, task in enumerate(read_tasks(self.root)) if task}
        except ExportError as error:
            known = {}
            self.change(f"The table of tasks is written again: {without_path(error, self.root)}")
        self.tasks = [known.get(number, "") for number in range(max(known, default=-1) + 1)]
        for number, run in enumerate(runs):
            place = stored.get(run.episode_index)
            own: tuple[str, ...] = place.tasks if place is not None and len(place.tasks) == 1 else ()
            indices = run.task_indices
            is_named = bool(indices) and all(index in known for index in indices)
            if is_named and (not own or own[0] in known.values() or len(indices) > 1):
                continue
            if not own and not indices and len(known) == 1:
                own = tuple(known.values())
            if not own:
                named = f"its rows name the task {indices[0]}, which no table has" if indices else "its rows name none"
                raise ExportError(
                    f"The instruction of episode {run.episode_index} is unknown ({named}): set one first "
                    f"(demorec dataset set-task --episodes {run.episode_index}): {self.root}"
                )
            self.instructions[number] = own[0]
            self.change(f"Episode {run.episode_index} has the instruction {own[0]!r} of the table of episodes.")

    def _check_timestamps(self) -> None:
        """Replace timestamps by multiples of 1/fps if they are not finite or LeRobot finds no images with them."""
        if "timestamp" not in open_table(self.data_tables[0]).schema_arrow.names:
            self.keeps_timestamps = False
            return
        rows, wrong, error_s = self.rows(["timestamp"]), 0, 0.0
        for place in self.listed:
            seconds = column_numbers(rows.read(place).column(0).combine_chunks())[:, 0].astype(np.float64)
            is_finite = bool(np.isfinite(seconds).all())
            if is_finite and (are_on_grid(seconds, self.info.fps) or not self.info.video_keys):
                continue
            wrong += 1
            if is_finite:
                error_s = max(error_s, float(np.abs(seconds - np.arange(len(seconds)) / self.info.fps).max()))
        if wrong:
            self.keeps_timestamps = False
            self.change(
                f"timestamp of {wrong} of {len(self.listed)} episodes is frame_index / fps, where LeRobot looks for "
                f"the images; the measured ones were up to {1000 * error_s:.1f} ms off."
            )


def _num_images(path: Path) -> int | None:
    """Number of images of a video; None if it cannot be read."""
    with suppress(ExportError):
        return len(mp4_index(path)[0])
    return None

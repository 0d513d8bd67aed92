"""The bags of one import: which are new, which are bad, and the order in which they come into the run.

They are read and then written, several at a time in processes of our own, with results in their order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, DemorecError, resource_error, without_path
from demorec.core.processes import process_pool
from demorec.episode.info import EpisodeInfo
from demorec.runs.external import ExternalFolder, differences
from demorec.runs.run_file import Attempt
from demorec.sources.bag import Bag, Files, open_bag
from demorec.sources.episode_writer import PlannedEpisode
from demorec.sources.import_file import BagReport, ImportFile, SkippedBag, save_import_file


class _Here(Executor):
    """Does everything at once, in this process."""

    def submit[R](self, function: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """The result, or what was raised; Ctrl-C is not kept for later."""
        future: Future[R] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """So many processes, or this one alone."""
    if workers == 1:
        yield _Here()
        return
    with process_pool(workers) as pool:
        yield pool


_MAX_REASON = 1000
"""Characters: an error may quote what a bag holds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedBag:
    """A bag that has been read.

    Attributes:
        bag: That one.
        report: Of all its episodes.
        episodes: That are to be written, numbered from 0 until the run's numbers are known.
    """

    bag: Bag
    report: BagReport
    episodes: tuple[PlannedEpisode, ...]

    def numbered(self, first: int) -> PlannedBag:
        """The same with the numbers of a run."""
        reports = (
            replace(row, episode_index=None if row.episode_index is None else row.episode_index + first)
            for row in self.report.episodes
        )
        episodes = (
            replace(episode, info=replace(episode.info, episode_index=episode.info.episode_index + first))
            for episode in self.episodes
        )
        return replace(self, report=replace(self.report, episodes=tuple(reports)), episodes=tuple(episodes))


class Batch:
    """The bags of one call: numbered and taken into the run in their order, whoever reads and writes them when.

    So what is in the run depends neither on how many processes there are nor on when they were interrupted.

    Attributes:
        num_new: Bags that were read now; the others were there.
    """

    def __init__(
        self, paths: Sequence[Path], known: ImportFile, *, skips: bool, progress: Callable[[int, int], None]
    ) -> None:
        self._paths, self._known, self._skips, self._progress = paths, known, skips, progress
        self._files: dict[Path, Files] = {}  # of bags that are in the run, or will be
        self._skipped: dict[Path, str] = {}
        self.num_new = self._num_done = 0
        self._next_index = known.num_episodes
        self._kind: EpisodeInfo | None = None
        self._progress(0, len(paths))

    def look(self, pool: Executor) -> list[Bag]:
        """Open all bags; those that are not in the run yet."""
        bags = []
        for path in self._paths:
            try:
                bags.append(open_bag(path))
            except DemorecError as error:
                if not os.path.lexists(path):  # a name that was mistyped is no bad bag
                    raise
                self._refuse(path, error)
        known = {report.files for report in self._known.bags}
        sizes = {(report.num_bytes, *(name for name, _ in report.files)) for report in self._known.bags}
        likely = [bag for bag in bags if (bag.num_bytes, *(file.name for file in bag.files)) in sizes]
        for bag, files in zip(likely, pool.map(Bag.sha256s, likely), strict=True):
            if files in known:
                self._files[bag.path] = files
                self._advance()
        return [bag for bag in bags if bag.path not in self._files]

    def run(
        self,
        bags: Sequence[Bag],
        folder: ExternalFolder,
        pool: Executor,
        *,
        ahead: int,
        read: Callable[[Bag], PlannedBag],
        write: Callable[[PlannedBag], tuple[BagReport, list[Attempt]]],
        tell: Callable[[BagReport], None],
    ) -> None:
        """Take new bags into a run; what a bag raises is raised after all bags before it are there.

        Args:
            bags: Those that are not there yet.
            folder: Of the run.
            pool: Calls `read` and `write`, which pickle.
            ahead: How many bags are under way at a time: bounds the memory.
            read: Reads and judges a bag.
            write: Writes its episodes; its report, and their lines of run.json.
            tell: Called with the report of each bag that is in the run now.
        """
        self._kind = folder.kind()
        waiting, failure = deque(bags), None
        reading: deque[tuple[Bag, Future[PlannedBag]]] = deque()
        writing: deque[Future[tuple[BagReport, list[Attempt]]]] = deque()
        while waiting or reading or writing:
            while waiting and len(reading) + len(writing) < ahead:
                bag = waiting.popleft()
                reading.append((bag, pool.submit(read, bag)))
            if writing and writing[0].done():
                tell(self._take(folder, *writing.popleft().result()))
            elif reading and reading[0][1].done():
                try:
                    planned = self._accept(folder, *reading.popleft())
                except Exception as error:
                    failure = error
                    waiting.clear()
                    reading.clear()
                    continue
                if planned is not None:
                    writing.append(pool.submit(write, planned))
            else:
                first: list[Future[Any]] = [*list(writing)[:1], *(future for _, future in list(reading)[:1])]
                wait(first, return_when=FIRST_COMPLETED)
        if failure is not None:
            raise failure
        if self._known.bags:
            save_import_file(replace(self._known, skipped=self.skipped_bags()), folder.path)

    def _take(self, folder: ExternalFolder, report: BagReport, lines: Sequence[Attempt]) -> BagReport:
        """A bag whose episodes are written into the run."""
        folder.extend(lines)
        self._known = replace(self._known, bags=(*self._known.bags, report), skipped=self.skipped_bags())
        save_import_file(self._known, folder.path)
        self.num_new += 1
        self._advance()
        return report

    def _accept(self, folder: ExternalFolder, bag: Bag, read: Future[PlannedBag]) -> PlannedBag | None:
        """What is to be written of a bag, with its episodes' numbers; None for one that is left out or there."""
        try:
            planned = read.result()
            self._check_kind(planned, bag)
        except Exception as error:
            self._refuse(bag.path, error)
            return None
        is_there = planned.report.files in self._files.values()
        self._files[bag.path] = planned.report.files
        if is_there:  # another one with the same bytes
            self._advance()
            return None
        planned = planned.numbered(self._next_index)
        self._next_index += len(planned.episodes)
        return replace(planned, episodes=tuple(one for one in planned.episodes if not folder.has(one.info)))

    def _check_kind(self, planned: PlannedBag, bag: Bag) -> None:
        """ConfigError unless the episodes are of the kind that the run has."""
        for episode in planned.episodes[:1]:
            if self._kind is not None and (different := differences(self._kind, episode.info)):
                raise ConfigError(
                    f"The run holds episodes of another kind ({'; '.join(different)}): import the bag into another "
                    f"folder: {bag.path}"
                )
            self._kind = self._kind or episode.info

    def _refuse(self, path: Path, error: Exception) -> None:
        """Leave a bag out, or raise: where that was not asked for, or is the machine's fault."""
        if (lack := resource_error(error)) is not None:
            raise lack from error
        if not self._skips or isinstance(error, BrokenExecutor):
            raise error
        known = isinstance(error, DemorecError)
        self._skipped[path] = (
            without_path(error, path)[:_MAX_REASON] if known else f"unexpected {type(error).__name__}, please report it"
        )
        self._advance()

    def _advance(self) -> None:
        self._num_done += 1
        self._progress(self._num_done, len(self._paths))

    def skipped_bags(self) -> tuple[SkippedBag, ...]:
        """Those of this call, in order, behind those of earlier calls that are not given now."""
        given = {path.name for path in self._paths}
        before = [bag for bag in self._known.skipped if bag.name not in given]
        now = [SkippedBag(name=path.name, reason=self._skipped[path]) for path in self._paths if path in self._skipped]
        return (*before, *now)

    @property
    def reports(self) -> tuple[BagReport, ...]:
        """Of every bag that is in the run, in the order in which they were given."""
        reports = {report.files: report for report in self._known.bags}
        files = dict.fromkeys(self._files[path] for path in self._paths if path in self._files)
        return tuple(reports[key] for key in files)

    @property
    def skipped(self) -> dict[Path, str]:
        """Bags that were left out -> why."""
        return {path: self._skipped[path] for path in self._paths if path in self._skipped}

"""Import of bags to a run: every bag is read and judged as a whole, and only then written, episode by episode.

The same command continues: bags in import.json are not read again, existing episodes are not written again. Several
processes may read and write; bags are numbered and added to the run in order.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, DemorecError, resource_error, without_path
from demorec.core.plain import to_plain
from demorec.core.processes import process_pool
from demorec.episode.info import EpisodeInfo
from demorec.extensions.imports.bag import Bag, Files, bags_in, open_bag
from demorec.extensions.imports.bag_images import write_bag
from demorec.extensions.imports.description import urdf_text
from demorec.extensions.imports.import_file import BagReport, ImportFile, SkippedBag, load_import_file, save_import_file
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.extensions.imports.planning import PlannedBag, plan_bag
from demorec.runs.external import ExternalFolder, differences, is_cut_off, open_external_run
from demorec.runs.run_file import Attempt


def import_bags(
    paths: Sequence[Path],
    mapping_path: Path,
    out: Path,
    *,
    video: VideoConfig | None = None,
    workers: int = 1,
    skip_bad: bool = False,
    tell: Callable[[BagReport], None] = lambda report: None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ImportBatch:
    """Import bags to a run, by a mapping.

    Args:
        paths: Bags, each of which is one episode or several by the mapping; or folders of bags.
        mapping_path: Path of the mapping.
        out: The run's folder; a run started with the same mapping is continued.
        video: Encoding of images that arrive as pixels.
        workers: Number of processes that read and write; the recordings do not depend on it.
        skip_bad: Whether to leave out bags that cannot be read, or do not fit the mapping or the other bags. Otherwise
        the first of them ends the import before any of it is written.
        tell: Called with the report of each newly read bag, in order.
        progress: Called with the number of finished bags and the total.

    Returns:
        The batch, with `reports`, `num_new` and `skipped`.

    Raises:
        ConfigError: The mapping is impossible, or the folder holds other files.
        BagError: A bag cannot be read, does not fit the mapping, or would yield an incomplete episode.
        RecordingError: The disk is full or gone.
        GenerationError: A process of the import was killed.
    """
    mapping = read_mapping(mapping_path)
    urdf, video = urdf_text(mapping, mapping_path), video or VideoConfig()
    known = load_import_file(out)
    if known is None or not known.bags:
        known = ImportFile(mapping=to_plain(mapping), mapping_digest=mapping.digest)
    if known.mapping_digest != mapping.digest:
        raise ConfigError(f"The run was imported by another mapping: choose another --out: {out}")
    given = list(dict.fromkeys(bag for path in paths for bag in bags_in(path)))
    batch = ImportBatch(given, known, skips=skip_bad, progress=progress)
    with ExitStack() as stack:
        submit: Callable[..., Future[Any]]
        submit = _at_once if workers == 1 else stack.enter_context(process_pool(workers)).submit
        new = batch.look(lambda bag: submit(Bag.sha256s, bag))
        if new or is_cut_off(out) or (known.bags and batch.skipped_bags() != known.skipped):
            with open_external_run(out, recovers=False) as folder:
                batch.run(
                    new,
                    folder,
                    lambda bag: submit(plan_bag, bag, mapping, urdf, video),
                    lambda planned: submit(write_bag, planned, folder.path, video),
                    ahead=workers,
                    tell=tell,
                )
    return batch


def _in_order[Item, Result](
    begin: Callable[[Item], Future[Result]], items: Iterable[Item], ahead: int
) -> Iterator[tuple[Item, Future[Result]]]:
    """Yield each item and its started work, in order; up to `ahead` are in progress, to limit memory."""
    waiting: deque[tuple[Item, Future[Result]]] = deque()
    for item in items:
        waiting.append((item, begin(item)))
        while waiting and (len(waiting) >= ahead or waiting[0][1].done()):
            yield waiting.popleft()
    yield from waiting


def _at_once[R](function: Callable[..., R], *args: Any) -> Future[R]:
    """Run at once in this process, with the interface of an executor's `submit`; Ctrl-C is raised immediately."""
    future: Future[R] = Future()
    try:
        future.set_result(function(*args))
    except Exception as error:
        future.set_exception(error)
    return future


_Written = tuple[BagReport, list[Attempt]]
"""Report of a bag with written episodes, and their lines of run.json."""
_MAX_REASON = 1000
"""Maximum characters: an error may quote a bag's content."""


class ImportBatch:
    """Bags of one call, numbered and added to the run in order, independent of which process reads and writes them.

    The run thus depends neither on the number of processes nor on interruptions.

    Attributes:
        num_new: Bags read now; the others existed.
    """

    def __init__(
        self, paths: Sequence[Path], known: ImportFile, *, skips: bool, progress: Callable[[int, int], None]
    ) -> None:
        self._paths, self._known, self._skips, self._progress = paths, known, skips, progress
        self._left = list(paths)  # to be added to the run, or left out
        self._files: dict[Path, Files] = {}  # of bags that are in the run, or will be
        self._skipped: dict[Path, str] = {}
        self.num_new = self._num_done = 0
        self._next_index = known.num_episodes
        self._kind: EpisodeInfo | None = None
        self._failure: Exception | None = None
        self._progress(0, len(paths))

    def look(self, digest: Callable[[Bag], Future[Files]]) -> list[Bag]:
        """Open all bags; return those not yet in the run, by `digest` if sizes and names are known."""
        bags = []
        for path in self._paths:
            try:
                bags.append(open_bag(path))
            except DemorecError as error:
                if not os.path.lexists(path):  # a mistyped name is not a bad bag
                    raise
                self._refuse(path, error)
        known = {report.files for report in self._known.bags}
        sizes = {(report.num_bytes, *(name for name, _ in report.files)) for report in self._known.bags}
        likely = [bag for bag in bags if (bag.num_bytes, *(file.name for file in bag.files)) in sizes]
        for bag, found in [(bag, digest(bag)) for bag in likely]:
            if (files := found.result()) in known:
                self._files[bag.path] = files
                self._advance(bag.path)
        return [bag for bag in bags if bag.path not in self._files]

    def run(
        self,
        bags: Sequence[Bag],
        folder: ExternalFolder,
        read: Callable[[Bag], Future[PlannedBag]],
        write: Callable[[PlannedBag], Future[_Written]],
        *,
        ahead: int,
        tell: Callable[[BagReport], None],
    ) -> None:
        """Add new bags to a run; an error of a bag is raised after all bags before it were added.

        Args:
            bags: New bags.
            folder: Folder of the run.
            read: Starts reading and judging a bag.
            write: Starts writing its episodes.
            ahead: Maximum bags being read, and being written, at a time.
            tell: Called with the report of each added bag.
        """
        self._kind = folder.kind()
        folder.planned = [path.name for path in self._left]
        planned = self._accepted(folder, _in_order(read, bags, ahead))
        for bag, written in _in_order(write, planned, ahead):
            report, lines = written.result()
            self._take(folder, bag.bag.path, report, lines)
            tell(report)
        folder.planned = [path.name for path in self._left]
        if self._failure is not None:
            raise self._failure
        if self._known.bags:
            save_import_file(replace(self._known, skipped=self.skipped_bags()), folder.path)

    def _accepted(self, folder: ExternalFolder, bags: Iterator[tuple[Bag, Future[PlannedBag]]]) -> Iterator[PlannedBag]:
        """Yield the planned episodes of each bag, up to the first bag that ends the import."""
        try:
            for bag, read in bags:
                planned = self._accept(folder, bag, read)
                if planned is not None:
                    yield planned
        except Exception as error:
            self._failure = error

    def _take(self, folder: ExternalFolder, path: Path, report: BagReport, lines: Sequence[Attempt]) -> None:
        """Add a written bag to the run; run.json, which marks it as done, is written last."""
        self._known = replace(self._known, bags=(*self._known.bags, report), skipped=self.skipped_bags())
        save_import_file(self._known, folder.path)
        self.num_new += 1
        self._advance(path)
        folder.planned = [path.name for path in self._left]
        folder.extend(lines)

    def _accept(self, folder: ExternalFolder, bag: Bag, read: Future[PlannedBag]) -> PlannedBag | None:
        """Return the bag with the numbers of its new episodes; None if it is left out or existed."""
        try:
            planned = read.result()
            if planned.episodes:
                info = planned.episodes[0].info
                self._kind = self._kind or info
                if different := differences(self._kind, info):
                    raise ConfigError(
                        f"The run's episodes differ from the bag's ({'; '.join(different)}): import it into another "
                        f"folder: {bag.path}"
                    )
        except Exception as error:
            self._refuse(bag.path, error)
            return None
        is_there = planned.report.files in self._files.values()
        self._files[bag.path] = planned.report.files
        if is_there:  # another bag with the same bytes
            self._advance(bag.path)
            return None
        if planned.episodes:
            folder.begin(planned.episodes[0].info)
        planned = planned.numbered(self._next_index)
        self._next_index += len(planned.episodes)
        return replace(planned, episodes=tuple(one for one in planned.episodes if not folder.has(one.info)))

    def _refuse(self, path: Path, error: Exception) -> None:
        """Leave a bag out, or raise if that was not requested or the machine is at fault."""
        if (lack := resource_error(error)) is not None:
            raise lack from error
        if not self._skips or isinstance(error, BrokenExecutor):
            raise error
        known = isinstance(error, DemorecError)
        self._skipped[path] = (
            without_path(error, path)[:_MAX_REASON] if known else f"unexpected {type(error).__name__}, please report it"
        )
        self._advance(path)

    def _advance(self, path: Path) -> None:
        self._left.remove(path)
        self._num_done += 1
        self._progress(self._num_done, len(self._paths))

    def skipped_bags(self) -> tuple[SkippedBag, ...]:
        """Skipped bags of this call, in order, after those of earlier calls that are not given now."""
        given = {path.name for path in self._paths}
        before = [bag for bag in self._known.skipped if bag.name not in given]
        return (*before, *(SkippedBag(name=path.name, reason=reason) for path, reason in self.skipped.items()))

    @property
    def num_episodes(self) -> int:
        """Number of episodes from the bags."""
        return sum(len(report.made) for report in self.reports)

    def left_out_lines(self) -> Iterator[str]:
        """Describe dropped parts and findings."""
        yield from (f"{report.name}: {line}" for report in self.reports for line in report.dropped_lines())

    @property
    def reports(self) -> tuple[BagReport, ...]:
        """Reports of the bags in the run, in the given order."""
        reports = {report.files: report for report in self._known.bags}
        files = dict.fromkeys(self._files[path] for path in self._paths if path in self._files)
        return tuple(reports[key] for key in files)

    @property
    def skipped(self) -> dict[Path, str]:
        """Skipped bag -> reason."""
        return {path: self._skipped[path] for path in self._paths if path in self._skipped}

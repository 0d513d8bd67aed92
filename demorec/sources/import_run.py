"""Bags become a run: every bag is read, judged as a whole, and only then written, episode by episode.

The same command again goes on: bags that import.json knows are not read, episodes that are there are not written.
Several processes may read and write; bags are numbered and taken into the run in their order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.plain import to_plain
from demorec.episode.info import SourceFile
from demorec.episode.validity import find_problems
from demorec.mcap.frame_check import MAX_STAMP_NS, MAX_SUBTASK
from demorec.mcap.limits import LimitError, Limits
from demorec.mcap.video import size_problem
from demorec.runs.external import (
    differences,
    episode_path,
    external_line,
    open_external_run,
)
from demorec.runs.run_file import Attempt
from demorec.sources.bag import Bag, Files, bags_in
from demorec.sources.bag_files import BagError
from demorec.sources.bag_findings import all_findings, row_findings
from demorec.sources.batch import Batch, PlannedBag, processes
from demorec.sources.clock import NS, Int
from demorec.sources.decoding import BagDecoder
from demorec.sources.episode_writer import (
    ImportedEpisodeWriter,
    PlannedEpisode,
    described_camera,
    described_feature,
    urdf_in_bag,
    urdf_text,
)
from demorec.sources.episodes import Window, subtask_rows, task_text, windows
from demorec.sources.fields import FieldError
from demorec.sources.frames_writer import imported_info, joints_of
from demorec.sources.import_file import BagReport, EpisodeReport, ImportFile, load_import_file, stream_reports
from demorec.sources.mapping import SourceMapping
from demorec.sources.mapping_file import read_mapping
from demorec.sources.rows import EpisodeRows, NoRowsError, Timelines
from demorec.sources.streams import read_streams


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
) -> Batch:
    """Import bags into a run, by a mapping.

    Args:
        paths: Of bags, each of which is an episode, or several as the mapping says; or of folders of bags.
        mapping_path: Of the mapping.
        out: The run's folder; one that the same mapping began is continued.
        video: How images are encoded that come as pixels.
        workers: Processes that read and write; the recordings are the same for any number of them.
        skip_bad: Whether bags are left out that cannot be read, or do not fit the mapping or the other bags. Else the
            first of them ends the import, before anything of it is written.
        tell: Called with the report of each bag that was read now, in their order.
        progress: Called with the number of bags that are done, and of all.

    Returns:
        What came of the bags: `reports`, `num_new` and `skipped`.

    Raises:
        ConfigError: The mapping is impossible, or the folder holds something else.
        BagError: A bag cannot be read, does not fit the mapping, or would give an episode with something missing.
        RecordingError: The disk is full or gone.
        GenerationError: A process of the import was killed.
    """
    mapping = read_mapping(mapping_path)
    importer = _Importer(mapping, urdf_text(mapping.robot.urdf, mapping_path), video or VideoConfig())
    known = load_import_file(out)
    if known is None or not known.bags:
        known = ImportFile(mapping=to_plain(mapping), mapping_digest=mapping.digest)
    if known.mapping_digest != mapping.digest:
        raise ConfigError(f"The run was imported by another mapping: choose another --out: {out}")
    given = list(dict.fromkeys(bag for path in paths for bag in bags_in(path)))
    batch = Batch(given, known, skips=skip_bad, progress=progress)
    with processes(workers) as pool:
        new = batch.look(pool)
        if new or (known.bags and batch.skipped_bags() != known.skipped):
            with open_external_run(out, recovers=False) as folder:
                ahead = 1 if workers == 1 else 2 * workers
                write = partial(importer.write, folder=folder.path)
                batch.run(new, folder, pool, ahead=ahead, read=importer.plan, write=write, tell=tell)
    return batch


@dataclass(frozen=True)
class _Importer:
    """Reads, judges and writes bags, in any process.

    Attributes:
        mapping: Of all bags.
        urdf: The robot's model, "" where the mapping names no file.
        video: How pixels are encoded.
    """

    mapping: SourceMapping
    urdf: str
    video: VideoConfig

    def plan(self, bag: Bag) -> PlannedBag:
        """Read and judge a bag."""
        files = bag.sha256s()
        streams = read_streams(bag, self.mapping)
        lines = Timelines(streams, self.mapping)
        found = windows(bag, streams, list(lines.lines.values()), self.mapping)
        findings = all_findings(lines)
        begin = min(int(line.times_ns[0]) for line in lines.lines.values() if len(line.times_ns))
        episodes: list[PlannedEpisode] = []
        reports: list[EpisodeReport] = []
        for window in found:
            if window.discarded:
                reports.append(_report(window, begin, None, f"its marker says {window.discarded!r}"))
                continue
            try:
                rows = lines.rows(window)
            except NoRowsError as error:
                if self.mapping.clock.when_old == "error":
                    kinds = {finding.kind: finding.kind for finding in findings}
                    offsets = [finding.text for finding in findings if finding.kind == "clock_offset"]
                    kinds |= {"clock_offset": f"clock_offset, {offsets[0]}"} if offsets else {}
                    reported = f" (the bag's report: {'; '.join(sorted(kinds.values()))})" if kinds else ""
                    raise BagError(f"The bag gives no whole episode: {error}{reported}: {bag.path}") from error
                reports.append(_report(window, begin, None, str(error)))
                continue
            episode = self._episode(bag, files, lines, rows, len(episodes))
            episodes.append(episode)
            reports.append(_report(window, begin, episode))
        _check_alike(bag, episodes)
        _check_images(bag, episodes)
        report = BagReport(
            name=bag.path.name,
            files=files,
            num_bytes=bag.num_bytes,
            streams=tuple(stream_reports(lines, [episode.rows for episode in episodes])),
            findings=(*findings, *row_findings(lines, [episode.rows for episode in episodes])),
            episodes=tuple(reports),
        )
        return PlannedBag(bag=bag, report=report, episodes=tuple(episodes))

    def _episode(self, bag: Bag, files: Files, lines: Timelines, rows: EpisodeRows, index: int) -> PlannedEpisode:
        topic = self.mapping.robot.urdf_topic
        urdf = urdf_in_bag(bag, lines.streams, topic) if topic else self.urdf
        try:
            joints = joints_of(urdf) if urdf else frozenset()
        except ValueError as error:
            raise BagError(f"The episode cannot be recorded: {error}: {bag.path}") from error
        info = imported_info(
            self.mapping,
            episode_index=index,
            instruction=task_text(bag, lines.streams, rows.window, self.mapping),
            urdf=urdf,
            fps=self.mapping.clock.fps,
            features=(described_feature(name, feature, lines, joints) for name, feature in rows.features.items()),
            cameras=(described_camera(name, plan, lines) for name, plan in rows.cameras.items()),
            files=(SourceFile(name=name, sha256=sha256) for name, sha256 in files),
        )
        subtasks = subtask_rows(bag, lines.streams, rows.window, rows.times_ns, self.mapping)
        episode = PlannedEpisode(info=info, rows=rows, subtasks=subtasks)
        if wrong := list(self._problems(episode)):
            raise BagError(f"The episode cannot be recorded: {'; '.join(wrong)}: {bag.path}")
        return episode

    def _problems(self, episode: PlannedEpisode) -> Iterator[str]:
        """What no recording can hold, found before anything of the bag is written."""
        yield from find_problems(episode.info)
        for name, plan in episode.rows.cameras.items():
            if not plan.kept and (problem := size_problem(self.video, plan.head.width, plan.head.height)):
                yield f"camera {name}: {problem}"
        if any(len(text) > MAX_SUBTASK or not text.isprintable() for text in episode.subtasks.values()):
            yield f"a subtask is no single line of at most {MAX_SUBTASK} characters"
        times, features = episode.rows.times_ns, episode.rows.features.values()
        cameras = episode.rows.cameras.values()
        for stamps in (times, *(times - one.ages_ns for one in features), *(one.stamps_ns for one in cameras)):
            if len(stamps) and not 0 <= stamps.min() <= stamps.max() <= MAX_STAMP_NS:
                yield f"a message is of the time {stamps.min() / NS:.0f} s, allowed are 0 to {MAX_STAMP_NS // NS} s"
                return

    def write(self, planned: PlannedBag, folder: Path) -> tuple[BagReport, list[Attempt]]:
        """Write a bag's episodes into a run; its report, and their lines of run.json."""
        self._write(planned.bag, planned.episodes, folder)
        paths = [episode_path(folder, episode.info.episode_index) for episode in planned.episodes]
        return planned.report, [external_line(path) for path in paths]

    def _write(self, bag: Bag, episodes: Sequence[PlannedEpisode], folder: Path) -> None:
        """Read the bag's images once more, and write each episode while they pass."""
        waiting = sorted(episodes, key=lambda episode: int(episode.rows.times_ns[0]))
        for episode in (episode for episode in waiting if not episode.rows.cameras):
            with self._writer(episode, folder) as writer:
                writer.finish()
        filmed = [episode for episode in waiting if episode.rows.cameras]
        if not filmed:
            return
        beginning = _first_images(filmed)
        begun: set[int] = set()
        with ExitStack() as stack:
            under_way: list[tuple[PlannedEpisode, ImportedEpisodeWriter]] = []
            for topic, number, values in _images(bag, filmed):
                for episode in beginning.get((topic, number), []):
                    if episode.info.episode_index not in begun:
                        begun.add(episode.info.episode_index)
                        under_way.append((episode, stack.enter_context(self._writer(episode, folder))))
                for pair in list(under_way):
                    episode, writer = pair
                    try:
                        writer.add(topic, number, values)
                    except FieldError as error:
                        raise _unusable(bag, topic, error) from error
                    if writer.is_complete:
                        writer.finish()
                        under_way.remove(pair)
            for _, writer in under_way:
                writer.finish()

    def _writer(self, episode: PlannedEpisode, folder: Path) -> ImportedEpisodeWriter:
        path = episode_path(folder, episode.info.episode_index)
        return ImportedEpisodeWriter(path, episode, video=self.video)


def _check_images(bag: Bag, episodes: Sequence[PlannedEpisode]) -> None:
    """BagError when the images unpack to more than a bag of its size holds: a PNG file of zeros is small."""
    limits = Limits.of_file(bag.num_bytes)
    plans = [plan for episode in episodes for plan in episode.rows.cameras.values()]
    try:
        limits.check_total(sum(len(plan.taken) * plan.num_bytes for plan in plans))
    except LimitError as error:
        raise BagError(f"The images of the bag cannot be used, since {error}: {bag.path}") from error


def _check_alike(bag: Bag, episodes: Sequence[PlannedEpisode]) -> None:
    """ConfigError unless the episodes are of one kind."""
    for episode in episodes[1:]:
        if different := differences(episodes[0].info, episode.info):
            raise ConfigError(f"The bag's episodes differ ({'; '.join(different)}): {bag.path}")


def _images(bag: Bag, episodes: Sequence[PlannedEpisode]) -> Iterator[tuple[str, int, dict[str, object]]]:
    """(topic, number, values) of the images that any episode takes."""
    taken: dict[str, list[Int]] = {}
    for episode in episodes:
        for plan in episode.rows.cameras.values():
            taken.setdefault(plan.topic, []).append(plan.taken)
    wanted = {topic: np.bincount(np.concatenate(numbers)) > 0 for topic, numbers in taken.items()}
    decoder, counts = BagDecoder(bag.num_bytes), dict.fromkeys(wanted, 0)
    for message in bag.messages([], wanted.keys()):
        topic = message.channel.topic
        number, counts[topic] = counts[topic], counts[topic] + 1
        if number < len(wanted[topic]) and wanted[topic][number]:
            try:
                values = decoder.values(message)
            except ValueError as error:
                raise _unusable(bag, topic, error) from error
            yield topic, number, values


def _unusable(bag: Bag, topic: str, error: ValueError) -> BagError:
    return BagError(f"An image of {topic} cannot be used, since {error}: {bag.path}")


def _first_images(episodes: Iterable[PlannedEpisode]) -> dict[tuple[str, int], list[PlannedEpisode]]:
    """(topic, number) -> the episodes whose first image of that topic it is; a topic's messages come in order."""
    found: dict[tuple[str, int], list[PlannedEpisode]] = {}
    for episode in episodes:
        for plan in episode.rows.cameras.values():
            found.setdefault((plan.topic, int(plan.taken.min())), []).append(episode)
    return found


def _report(window: Window, zero_ns: int, episode: PlannedEpisode | None, reason: str = "") -> EpisodeReport:
    """Of a window of a bag that begins at `zero_ns`, and the episode that comes of it, or why none does."""
    begin_ns, end_ns, count, trimmed_ns, follows = window.begin_ns, window.end_ns, 0, (0, 0), ""
    if episode is not None:
        times = episode.rows.times_ns
        begin_ns, end_ns, count, trimmed_ns = int(times[0]), int(times[-1]), len(times), episode.rows.trimmed_ns
        follows = episode.rows.follows
    return EpisodeReport(
        episode_index=None if episode is None else episode.info.episode_index,
        begin_s=(begin_ns - zero_ns) / NS,
        end_s=(end_ns - zero_ns) / NS,
        num_frames=count,
        success=window.success,
        trimmed_s=(trimmed_ns[0] / NS, trimmed_ns[1] / NS),
        pictures={} if episode is None else {name: plan.description for name, plan in episode.rows.cameras.items()},
        reason=reason,
        discarded=window.discarded,
        follows=follows,
    )

"""Bags become a run: every bag is read, judged as a whole, and only then written, episode by episode.

The same command again goes on: bags that import.json knows are not read, episodes that are there are not written.
Several processes may read and write; bags are numbered and taken into the run in their order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.episode.external import EpisodeInfo, Origin, SourceFile
from demorec.episode.validity import find_problems
from demorec.mcap.frame_check import MAX_STAMP_NS, MAX_SUBTASK
from demorec.mcap.limits import LimitError, Limits
from demorec.mcap.video import size_problem
from demorec.robots.urdf import Urdf
from demorec.runs.external import (
    ExternalEpisode,
    differences,
    episode_path,
    external_line,
    open_external_run,
)
from demorec.sources.bag import Bag, bags_in
from demorec.sources.bag_files import BagError
from demorec.sources.batch import Batch, ImportResult, Job, PlannedBag, files_of, processes
from demorec.sources.clock import NS, Int
from demorec.sources.decoding import BagDecoder
from demorec.sources.episode_writer import (
    ImportedEpisodeWriter,
    PlannedEpisode,
    described_camera,
    described_feature,
    picture_plan,
    urdf_in_bag,
    urdf_text,
)
from demorec.sources.episodes import Window, subtask_rows, task_text, windows
from demorec.sources.fields import FieldError
from demorec.sources.findings import LOST, NOTE, Finding, all_findings, of_stream
from demorec.sources.import_file import BagReport, EpisodeReport, ImportFile, load_import_file, stream_reports
from demorec.sources.mapping import SourceMapping
from demorec.sources.mapping_file import read_mapping
from demorec.sources.rows import RATE, EpisodeRows, NoRowsError, Timelines
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
) -> ImportResult:
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

    Raises:
        ConfigError: The mapping is impossible, or the folder holds something else.
        BagError: A bag cannot be read, does not fit the mapping, or would give an episode with something missing.
        RecordingError: The disk is full or gone.
        GenerationError: A process of the import was killed.
    """
    mapping = read_mapping(mapping_path)
    recipe = _Recipe(mapping, urdf_text(mapping.robot.urdf, mapping_path), video or VideoConfig())
    known = load_import_file(out)
    if known is None or not known.bags:
        known = ImportFile(mapping=mapping, mapping_digest=mapping.digest)
    if known.mapping_digest != mapping.digest:
        raise ConfigError(f"The run was imported by another mapping: choose another --out: {out}")
    given = list(dict.fromkeys(bag for path in paths for bag in bags_in(path)))
    batch = Batch(given, known, skips=skip_bad, progress=progress)
    with processes(workers) as pool:
        new = batch.look(pool)
        if new or (known.bags and batch.skipped_bags() != known.skipped):
            with open_external_run(out, recovers=False) as folder:
                ahead = 1 if workers == 1 else 2 * workers
                read, write = partial(_plan, recipe), partial(_write, recipe)
                batch.run(new, folder, pool, ahead=ahead, read=read, write=write, tell=tell)
    return batch.result()


@dataclass(frozen=True)
class _Recipe:
    """What all bags have in common."""

    mapping: SourceMapping
    urdf: str
    video: VideoConfig


def _plan(recipe: _Recipe, bag: Bag) -> PlannedBag:
    """Read and judge a bag."""
    return _Import(bag, dict(files_of(bag)), recipe.mapping, recipe.urdf, recipe.video).plan()


def _write(recipe: _Recipe, job: Job) -> tuple[BagReport, list[ExternalEpisode]]:
    """Write the episodes of a bag; its report, and their lines of run.json."""
    files = dict(job.report.files)
    _Import(job.bag, files, recipe.mapping, recipe.urdf, recipe.video).write(job.episodes, job.folder)
    paths = [episode_path(job.folder, episode.info.episode_index) for episode in job.episodes]
    return job.report, [external_line(path) for path in paths]


@dataclass(frozen=True, eq=False)
class _Import:
    """The import of one bag, whose files are given by name -> SHA-256."""

    bag: Bag
    files: dict[str, str]
    mapping: SourceMapping
    urdf: str
    video: VideoConfig

    def plan(self) -> PlannedBag:
        """Read and judge it."""
        streams = read_streams(self.bag, self.mapping)
        lines = Timelines(streams, self.mapping)
        found = windows(self.bag, streams, list(lines.lines.values()), self.mapping)
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
                    told = f" (the bag's report: {'; '.join(sorted(kinds.values()))})" if kinds else ""
                    raise BagError(f"The bag gives no whole episode: {error}{told}: {self.bag.path}") from error
                reports.append(_report(window, begin, None, str(error)))
                continue
            episode = self._episode(lines, rows, len(episodes))
            episodes.append(episode)
            reports.append(_report(window, begin, episode))
        self._check_alike(episodes)
        self._check_pictures(episodes)
        report = BagReport(
            name=self.bag.path.name,
            files=tuple(self.files.items()),
            num_bytes=self.bag.num_bytes,
            streams=tuple(stream_reports(lines, [episode.rows for episode in episodes])),
            findings=(*findings, *row_findings(lines, [episode.rows for episode in episodes])),
            episodes=tuple(reports),
        )
        return PlannedBag(report=report, episodes=tuple(episodes))

    def _episode(self, lines: Timelines, rows: EpisodeRows, index: int) -> PlannedEpisode:
        plans = {name: picture_plan(camera, lines.lines[name]) for name, camera in rows.cameras.items()}
        topic = self.mapping.robot.urdf_topic
        urdf = urdf_in_bag(self.bag, lines.streams, topic) if topic else self.urdf
        try:
            joints = {joint.name for joint in Urdf.parse(urdf).joints} if urdf else set()
        except ValueError as error:
            raise BagError(f"The robot's model cannot be used ({error}): {self.bag.path}") from error
        files = tuple(SourceFile(name=name, sha256=sha256) for name, sha256 in self.files.items())
        info = EpisodeInfo(
            episode_index=index,
            instruction=" ".join(task_text(self.bag, lines.streams, rows.window, self.mapping).split()),
            robot=self.mapping.robot.name,
            urdf=urdf,
            fps=self.mapping.clock.fps,
            features=tuple(described_feature(name, feature, lines, joints) for name, feature in rows.features.items()),
            cameras=tuple(described_camera(name, plan, lines) for name, plan in plans.items()),
            origin=Origin(kind="import", files=files, mapping_digest=self.mapping.digest),
            versions=dict(_versions()),
        )
        subtasks = subtask_rows(self.bag, lines.streams, rows.window, rows.times_ns, self.mapping)
        episode = PlannedEpisode(info=info, rows=rows, plans=plans, subtasks=subtasks)
        if wrong := list(self._problems(episode)):
            raise BagError(f"The episode cannot be recorded: {'; '.join(wrong)}: {self.bag.path}")
        return episode

    def _problems(self, episode: PlannedEpisode) -> Iterator[str]:
        """What no recording can hold, found before anything of the bag is written."""
        yield from find_problems(episode.info)
        for name, plan in episode.plans.items():
            if not plan.kept and (problem := size_problem(self.video, plan.head.width, plan.head.height)):
                yield f"camera {name}: {problem}"
        if any(len(text) > MAX_SUBTASK or not text.isprintable() for text in episode.subtasks.values()):
            yield f"a subtask is no single line of at most {MAX_SUBTASK} characters"
        times, features = episode.rows.times_ns, episode.rows.features.values()
        for stamps in (
            times,
            *(times - one.ages_ns for one in features),
            *(p.stamps_ns for p in episode.plans.values()),
        ):
            if len(stamps) and not 0 <= stamps.min() <= stamps.max() <= MAX_STAMP_NS:
                yield f"a message is of the time {stamps.min() / NS:.0f} s, allowed are 0 to {MAX_STAMP_NS // NS} s"
                return

    def _check_pictures(self, episodes: Sequence[PlannedEpisode]) -> None:
        """BagError when the images unpack to more than a bag of its size holds: a PNG file of zeros is small."""
        limits = Limits.of_file(self.bag.num_bytes)
        plans = [plan for episode in episodes for plan in episode.plans.values()]
        try:
            limits.check_total(sum(len(plan.numbers) * plan.num_bytes for plan in plans))
        except LimitError as error:
            raise BagError(f"The images of the bag cannot be used, since {error}: {self.bag.path}") from error

    def _check_alike(self, episodes: Sequence[PlannedEpisode]) -> None:
        """ConfigError unless the episodes are of one kind."""
        for episode in episodes[1:]:
            if different := differences(episodes[0].info, episode.info):
                raise ConfigError(f"The bag's episodes differ ({'; '.join(different)}): {self.bag.path}")

    def write(self, episodes: Sequence[PlannedEpisode], folder: Path) -> None:
        """Read the bag's images once more, and write each episode into a run while they pass."""
        waiting = sorted(episodes, key=lambda episode: int(episode.rows.times_ns[0]))
        for episode in (episode for episode in waiting if not episode.plans):
            with self._writer(episode, folder) as writer:
                writer.finish()
        filmed = [episode for episode in waiting if episode.plans]
        if not filmed:
            return
        beginning = _first_pictures(filmed)
        begun: set[int] = set()
        with ExitStack() as stack:
            under_way: list[tuple[PlannedEpisode, ImportedEpisodeWriter]] = []
            for topic, number, values in self._pictures(filmed):
                for episode in beginning.get((topic, number), []):
                    if episode.info.episode_index not in begun:
                        begun.add(episode.info.episode_index)
                        under_way.append((episode, stack.enter_context(self._writer(episode, folder))))
                for pair in list(under_way):
                    episode, writer = pair
                    try:
                        writer.add(topic, number, values)
                    except FieldError as error:
                        raise self._unusable(topic, error) from error
                    if writer.is_complete:
                        writer.finish()
                        under_way.remove(pair)
            for _, writer in under_way:
                writer.finish()

    def _writer(self, episode: PlannedEpisode, folder: Path) -> ImportedEpisodeWriter:
        path = episode_path(folder, episode.info.episode_index)
        return ImportedEpisodeWriter(path, episode, video=self.video)

    def _pictures(self, episodes: Sequence[PlannedEpisode]) -> Iterator[tuple[str, int, dict[str, object]]]:
        """(topic, number, values) of the images that any episode takes."""
        taken: dict[str, list[Int]] = {}
        for episode in episodes:
            for plan in episode.plans.values():
                taken.setdefault(plan.topic, []).append(plan.numbers)
        wanted = {topic: np.bincount(np.concatenate(numbers)) > 0 for topic, numbers in taken.items()}
        decoder, counts = BagDecoder(self.bag.num_bytes), dict.fromkeys(wanted, 0)
        for message in self.bag.messages([], wanted.keys()):
            topic = message.channel.topic
            number, counts[topic] = counts[topic], counts[topic] + 1
            if number < len(wanted[topic]) and wanted[topic][number]:
                try:
                    values = decoder.values(message)
                except ValueError as error:
                    raise self._unusable(topic, error) from error
                yield topic, number, values

    def _unusable(self, topic: str, error: ValueError) -> BagError:
        return BagError(f"An image of {topic} cannot be used, since {error}: {self.bag.path}")


@cache
def _versions() -> Mapping[str, str]:
    return {name: version(name) for name in ("demorec", "av")}


def _first_pictures(episodes: Iterable[PlannedEpisode]) -> dict[tuple[str, int], list[PlannedEpisode]]:
    """(topic, number) -> the episodes whose first image of that topic it is; a topic's messages come in order."""
    found: dict[tuple[str, int], list[PlannedEpisode]] = {}
    for episode in episodes:
        for plan in episode.plans.values():
            found.setdefault((plan.topic, int(plan.numbers.min())), []).append(episode)
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
        pictures={} if episode is None else {name: plan.told for name, plan in episode.plans.items()},
        reason=reason,
        discarded=window.discarded,
        follows=follows,
    )


def row_findings(lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[Finding]:
    """What is odd in the rows of a bag's episodes, each thing once."""
    fps = lines.mapping.clock.fps
    for rows in (rows for rows in episodes if rows.follows and len(rows.times_ns) > 1):
        steps = np.diff(rows.times_ns)
        rate = NS / float(steps[steps <= LOST * np.median(steps)].mean())
        if abs(rate - fps) > RATE * fps:
            text = f"rows follow its messages, {rate:.1f} a second, fps says {fps}"
            yield Finding(kind="fps", stream=rows.follows, text=text)
            break
    for name in lines.mapping.cameras if episodes else ():
        yield from _use_findings(name, lines, episodes)


def _use_findings(name: str, lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[Finding]:
    """What becomes of a camera's images: a finding where rows could show more of them, else a note."""
    line, clock = lines.lines[name], lines.mapping.clock
    num_repeated = num_free = num_skipped = num_images = 0
    for rows in episodes:
        shown = lines.chosen(name, rows.times_ns).index
        steps = np.diff(shown)
        repeated = shown[1:][steps == 0]
        num_repeated += len(repeated)
        # Not those where an image is missing, or the stream is at its end; and an episode may begin between two images.
        repeated = repeated[repeated < len(line.times_ns) - 1]
        waits = line.times_ns[repeated + 1] - line.times_ns[repeated]
        num_free += max(0, int(np.sum(waits <= LOST * line.period_ns)) - 1)
        num_skipped += int(np.maximum(steps - 1, 0).sum())
        num_images += int(shown[-1] - shown[0]) + 1
    num_rows = sum(len(rows.times_ns) for rows in episodes)
    rate = NS / max(line.period_ns, 1)
    repeats = f"{100 * num_repeated / num_rows:.3g} % of the rows show the image before"
    skips = f"{100 * num_skipped / num_images:.3g} % of its images are in no row"
    if min(num_free, num_skipped):  # where a row repeats and another skips, other rows would lose nothing
        advice = 'use rows = "camera"'
        if abs(rate - clock.fps) > max(RATE * clock.fps, 0.5):
            advice = f"use fps = {max(1, round(rate))}"
        elif clock.rows == "camera":
            advice = "they come too unevenly for these rows"
        yield of_stream(line.stream, "repeats", f"{repeats} and {skips}: {advice}")
    elif max(num_free / num_rows, num_skipped / num_images) > RATE:
        told = f"{repeats if num_free else skips}, since it comes {rate:.1f} times a second and rows {clock.fps} times"
        # Every second image can be meant; now the next one and now the one after it only beside a slower camera.
        is_uneven = abs(rate / clock.fps - round(rate / clock.fps)) > RATE
        if num_skipped and is_uneven and not any(rows.follows for rows in episodes):
            yield of_stream(line.stream, "skips", f"{told}: use fps = {max(1, round(rate))}")
        else:
            yield of_stream(line.stream, NOTE, told)
    elif num_skipped and (follows := next((rows.follows for rows in episodes if rows.follows), "")):
        yield of_stream(line.stream, NOTE, f"{skips}: rows follow {follows}")

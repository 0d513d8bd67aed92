"""Bags become a run: every bag is read, judged as a whole, and only then written, episode by episode.

The same command again goes on: bags that import.json knows are not read, episodes that are there are not written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from demorec.config import VideoConfig
from demorec.errors import ConfigError
from demorec.ingest.bag import Bag, open_bag
from demorec.ingest.channel import BagError
from demorec.ingest.clock import NS, Int
from demorec.ingest.description import described_camera, described_feature, urdf_in_bag, urdf_text
from demorec.ingest.episode_writer import ImportedEpisodeWriter, PlannedEpisode, picture_plan
from demorec.ingest.episodes import Window, subtask_rows, task_text, windows
from demorec.ingest.fields import FieldError
from demorec.ingest.findings import all_findings
from demorec.ingest.import_file import ImportFile, load_import_file, save_import_file
from demorec.ingest.mapping import BagMapping, read_mapping
from demorec.ingest.report import BagReport, EpisodeReport, stream_reports
from demorec.ingest.rows import EpisodeRows, NoRowsError, Timelines
from demorec.ingest.streams import BagDecoder, read_streams
from demorec.recording.limits import LimitError, Limits
from demorec.runs.collected import CollectedFolder, differences, open_collected_run
from demorec.scene.collected import CollectedInfo, Origin, SourceFile
from demorec.scene.urdf import Urdf


@dataclass(frozen=True, kw_only=True)
class ImportResult:
    """What an import made.

    Attributes:
        reports: Of every bag, in the order in which they were given.
        num_new: Bags that were read now; the others were there.
    """

    reports: tuple[BagReport, ...]
    num_new: int


def import_bags(
    paths: Sequence[Path],
    mapping_path: Path,
    out: Path,
    *,
    video: VideoConfig | None = None,
    tell: Callable[[BagReport], None] = lambda report: None,
) -> ImportResult:
    """Import bags into a run, by a mapping.

    Args:
        paths: Of bags: each is an episode, or several as the mapping says.
        mapping_path: Of the mapping.
        out: The run's folder; one that the same mapping began is continued.
        video: How pictures are coded that come as pixels.
        tell: Called with the report of each bag that was read now.

    Raises:
        ConfigError: The mapping is impossible, or the folder holds something else.
        BagError: A bag cannot be read, does not fit the mapping, or would give an episode with something missing.
        RecordingError: The disk is full or gone.
    """
    mapping = read_mapping(mapping_path)
    urdf = urdf_text(mapping.robot.urdf, mapping_path)
    bags = [open_bag(path) for path in paths]
    known = load_import_file(out) or ImportFile(mapping=mapping, mapping_digest=mapping.digest)
    if known.mapping_digest != mapping.digest:
        raise ConfigError(f"The run was imported by another mapping: choose another --out: {out}")
    hashes = [tuple(bag.sha256s().items()) for bag in bags]
    reports = {report.files: report for report in known.bags}
    new = {files: bag for files, bag in zip(hashes, bags, strict=True) if files not in reports}
    if new:
        with open_collected_run(out, recovers=False) as folder:
            for files, bag in new.items():
                first = sum(episode.episode_index is not None for row in known.bags for episode in row.episodes)
                report = _Import(bag, dict(files), mapping, urdf, folder, video or VideoConfig()).run(first)
                known = replace(known, bags=(*known.bags, report))
                save_import_file(known, out)
                reports[files] = report
                tell(report)
    return ImportResult(reports=tuple(reports[files] for files in dict.fromkeys(hashes)), num_new=len(new))


@dataclass(frozen=True, eq=False)
class _Import:
    """The import of one bag, whose files are given by name -> SHA-256."""

    bag: Bag
    files: dict[str, str]
    mapping: BagMapping
    urdf: str
    folder: CollectedFolder
    video: VideoConfig

    def run(self, first_index: int) -> BagReport:
        """Read, judge and write it."""
        streams = read_streams(self.bag, self.mapping)
        lines = Timelines(streams, self.mapping)
        found = windows(self.bag, streams, list(lines.lines.values()), self.mapping)
        findings = all_findings(lines)
        begin = min(window.begin_ns for window in found)
        episodes: list[PlannedEpisode] = []
        reports: list[EpisodeReport] = []
        for window in found:
            try:
                rows = lines.rows(window)
            except NoRowsError as error:
                if self.mapping.clock.when_old == "error":
                    kinds = sorted({finding.kind for finding in findings})
                    told = f" (the bag's report: {', '.join(kinds)})" if kinds else ""
                    raise BagError(f"The bag gives no whole episode: {error}{told}: {self.bag.path}") from error
                reports.append(_report(window, begin, None, str(error)))
                continue
            episode = self._episode(lines, rows, first_index + len(episodes))
            episodes.append(episode)
            reports.append(_report(window, begin, episode))
        self._check_alike(episodes)
        self._check_pictures(episodes)
        self._write([episode for episode in episodes if not self.folder.has(episode.info)])
        return BagReport(
            name=self.bag.path.name,
            files=tuple(self.files.items()),
            num_bytes=self.bag.num_bytes,
            streams=tuple(stream_reports(lines, [episode.rows for episode in episodes])),
            findings=findings,
            episodes=tuple(reports),
        )

    def _episode(self, lines: Timelines, rows: EpisodeRows, index: int) -> PlannedEpisode:
        plans = {name: picture_plan(camera, lines.lines[name]) for name, camera in rows.cameras.items()}
        topic = self.mapping.robot.urdf_topic
        urdf = urdf_in_bag(self.bag, lines.streams, topic) if topic else self.urdf
        try:
            joints = {joint.name for joint in Urdf.parse(urdf).joints} if urdf else set()
        except ValueError as error:
            raise BagError(f"The robot's model cannot be used ({error}): {self.bag.path}") from error
        files = tuple(SourceFile(name=name, sha256=sha256) for name, sha256 in self.files.items())
        info = CollectedInfo(
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
        return PlannedEpisode(info=info, rows=rows, plans=plans, subtasks=subtasks)

    def _check_pictures(self, episodes: Sequence[PlannedEpisode]) -> None:
        """BagError when the pictures unpack to more than a bag of its size holds: a PNG file of zeros is small."""
        limits = Limits.of_file(self.bag.num_bytes)
        plans = [plan for episode in episodes for plan in episode.plans.values()]
        try:
            limits.check_total(sum(len(plan.numbers) * plan.num_bytes for plan in plans))
        except LimitError as error:
            raise BagError(f"The pictures of the bag cannot be used, since {error}: {self.bag.path}") from error

    def _check_alike(self, episodes: Sequence[PlannedEpisode]) -> None:
        """ConfigError unless the episodes are of the kind that the run holds, and of one kind."""
        for episode in episodes[:1]:
            self.folder.check_fits(episode.info)
        for episode in episodes[1:]:
            if different := differences(episodes[0].info, episode.info):
                raise ConfigError(f"The bag's episodes differ ({'; '.join(different)}): {self.bag.path}")

    def _write(self, episodes: list[PlannedEpisode]) -> None:
        """Read the bag's pictures once more, and write each episode while they pass."""
        waiting = sorted(episodes, key=lambda episode: int(episode.rows.times_ns[0]))
        for episode in (episode for episode in waiting if not episode.plans):
            with self._writer(episode) as writer:
                self._finish(episode, writer)
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
                        under_way.append((episode, stack.enter_context(self._writer(episode))))
                for pair in list(under_way):
                    episode, writer = pair
                    try:
                        writer.add(topic, number, values)
                    except FieldError as error:
                        raise self._unusable(topic, error) from error
                    if writer.is_complete:
                        self._finish(episode, writer)
                        under_way.remove(pair)
            for episode, writer in under_way:
                self._finish(episode, writer)

    def _finish(self, episode: PlannedEpisode, writer: ImportedEpisodeWriter) -> None:
        writer.finish()
        self.folder.add(self.folder.path_of(episode.info.episode_index))

    def _writer(self, episode: PlannedEpisode) -> ImportedEpisodeWriter:
        path = self.folder.path_of(episode.info.episode_index)
        return ImportedEpisodeWriter(path, episode, video=self.video)

    def _pictures(self, episodes: Sequence[PlannedEpisode]) -> Iterator[tuple[str, int, dict[str, object]]]:
        """(topic, number, values) of the pictures that any episode takes."""
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
        return BagError(f"A picture of {topic} cannot be used, since {error}: {self.bag.path}")


@cache
def _versions() -> Mapping[str, str]:
    return {name: version(name) for name in ("demorec", "av")}


def _first_pictures(episodes: Iterable[PlannedEpisode]) -> dict[tuple[str, int], list[PlannedEpisode]]:
    """(topic, number) -> the episodes whose first picture of that topic it is; a topic's messages come in order."""
    found: dict[tuple[str, int], list[PlannedEpisode]] = {}
    for episode in episodes:
        for plan in episode.plans.values():
            found.setdefault((plan.topic, int(plan.numbers.min())), []).append(episode)
    return found


def _report(window: Window, zero_ns: int, episode: PlannedEpisode | None, reason: str = "") -> EpisodeReport:
    """Of a window of a bag that begins at `zero_ns`, and the episode that comes of it, or why none does."""
    begin_ns, end_ns, count, trimmed_ns = window.begin_ns, window.end_ns, 0, (0, 0)
    if episode is not None:
        times = episode.rows.times_ns
        begin_ns, end_ns, count, trimmed_ns = int(times[0]), int(times[-1]), len(times), episode.rows.trimmed_ns
    return EpisodeReport(
        episode_index=None if episode is None else episode.info.episode_index,
        begin_s=(begin_ns - zero_ns) / NS,
        end_s=(end_ns - zero_ns) / NS,
        num_frames=count,
        success=window.success,
        trimmed_s=(trimmed_ns[0] / NS, trimmed_ns[1] / NS),
        pictures={} if episode is None else {name: plan.told for name, plan in episode.plans.items()},
        reason=reason,
    )

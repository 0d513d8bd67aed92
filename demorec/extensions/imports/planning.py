"""Read and judge a bag as a whole: plan the episodes to record, and report all findings.

The mapping defines the boundaries, tasks and outcomes of episodes by the bag's content.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.episode.info import Camera, EpisodeInfo, Feature, SourceFile
from demorec.episode.validity import find_problems
from demorec.extensions.imports.bag import NS, Bag, Files
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.description import imported_feature, imported_info
from demorec.extensions.imports.fields import FieldError
from demorec.extensions.imports.findings import ImportFinding, bag_findings, row_findings
from demorec.extensions.imports.import_file import BagReport, EpisodeReport, stream_figures
from demorec.extensions.imports.mapping import Episodes, SourceMapping
from demorec.extensions.imports.rows import EpisodeRows, NoRowsError, TakenImages, Timelines, Window
from demorec.extensions.imports.streams import Text, read_streams
from demorec.extensions.imports.words import stated_task
from demorec.mcap.sampled_writer import MAX_STAMP_NS
from demorec.mcap.video import size_problem
from demorec.runs.external import differences

_SHOWN = 40
"""Maximum characters of a marker in an error."""
_MOST_LISTED = 5
"""Maximum number of markers in an error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedEpisode:
    """An episode to write."""

    info: EpisodeInfo
    rows: EpisodeRows


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedBag:
    """A bag that has been read."""

    bag: Bag
    report: BagReport
    episodes: tuple[PlannedEpisode, ...]

    def numbered(self, first: int) -> PlannedBag:
        """Renumber the episodes for a run."""
        reports = (
            replace(row, episode_index=None if row.episode_index is None else row.episode_index + first)
            for row in self.report.episodes
        )
        episodes = (
            replace(episode, info=replace(episode.info, episode_index=episode.info.episode_index + first))
            for episode in self.episodes
        )
        return replace(self, report=replace(self.report, episodes=tuple(reports)), episodes=tuple(episodes))


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """Settings of an import; `urdf` is None if the mapping names no file."""

    mapping: SourceMapping
    urdf: str | None
    video: VideoConfig


def plan_bag(bag: Bag, files: Files, settings: ImportSettings) -> PlannedBag:
    """Read and judge a bag; its episodes are numbered from 0.

    Raises:
        BagError: It cannot be read, does not fit the mapping, or would yield an incomplete episode.
        ConfigError: Its episodes differ.
    """
    mapping = settings.mapping
    streams = read_streams(bag, mapping)
    try:
        lines = Timelines(streams, mapping)
        findings = bag_findings(lines)
        begin = min(int(line.times_ns[0]) for line in lines.lines.values())
        episodes: list[PlannedEpisode] = []
        reports: list[EpisodeReport] = []
        for window in windows(lines):
            episode, reason = None, f"its marker is {window.discarded!r}" if window.discarded else ""
            try:
                if not window.discarded:
                    rows = lines.rows(window)
                    episode = _episode(bag, files, lines, rows, settings, len(episodes))
                    episodes.append(episode)
            except NoRowsError as error:
                if mapping.clock.when_old == "error":
                    raise BagError(f"The bag yields no complete episode: {error}{_reported(findings)}") from error
                reason = str(error)
            reports.append(_report(window, begin, episode, reason))
        for episode in episodes:
            if different := differences(episodes[0].info, episode.info):
                raise ConfigError(f"The bag's episodes differ ({'; '.join(different)}): {bag.path}")
    except BagError as error:
        raise BagError(f"{error}: {bag.path}") from error
    rows_of = [episode.rows for episode in episodes]
    report = BagReport(
        name=bag.path.name,
        files=files,
        num_bytes=bag.num_bytes,
        streams=tuple(stream_figures(line, rows_of) for line in lines.lines.values()),
        findings=(*findings, *row_findings(lines, rows_of)),
        episodes=tuple(reports),
    )
    return PlannedBag(bag=bag, report=report, episodes=tuple(episodes))


def _reported(findings: Sequence[ImportFinding]) -> str:
    """Other findings in a bag without a complete episode, as possible causes; a clock's offset with its remedy."""
    texts = {finding.kind: finding.text for finding in reversed(findings)}
    kinds = [f"{kind}, {text}" if kind == "clock_offset" else kind for kind, text in sorted(texts.items())]
    return f" (the bag's report: {'; '.join(kinds)})" if kinds else ""


def _episode(
    bag: Bag, files: Files, lines: Timelines, rows: EpisodeRows, settings: ImportSettings, index: int
) -> PlannedEpisode:
    """Describe an episode; BagError if it cannot be recorded, before anything of the bag is written."""
    mapping, urdf = lines.mapping, settings.urdf
    if topic := mapping.robot.urdf_topic:
        texts = lines.streams.texts[topic]
        urdf = texts[0].value if texts else ""
        if not isinstance(urdf, str) or not urdf.strip():
            raise BagError(f"{topic} holds no robot description")
    try:
        info = imported_info(
            mapping,
            episode_index=index,
            instruction=stated_task(mapping.task, bag.name),
            urdf=urdf,
            fps=mapping.clock.fps,
            features=(_feature(name, values.dtype, lines) for name, values in rows.table.features.items()),
            cameras=(_camera(name, plan, lines) for name, plan in rows.cameras.items()),
            files=(SourceFile(name=name, sha256=sha256) for name, sha256 in files),
        )
        episode = PlannedEpisode(info=info, rows=rows)
        if wrong := list(_problems(episode, settings.video)):
            raise FieldError("; ".join(wrong))
    except FieldError as error:
        raise BagError(f"The episode cannot be recorded: {error}") from error
    return episode


def windows(lines: Timelines) -> list[Window]:
    """Episodes of a bag, in order; BagError if it has none, or a marker has no meaning."""
    begin = min(int(line.times_ns[0]) for line in lines.lines.values())
    end = max(int(line.times_ns[-1]) for line in lines.lines.values())
    episodes = lines.mapping.episodes
    if episodes.cut == "file":
        return [Window(begin_ns=begin, end_ns=end)]
    markers = lines.streams.texts[episodes.topic]
    known = {True, False, "", *_words(episodes)}
    if unknown := dict.fromkeys(repr(marker.value)[:_SHOWN] for marker in markers if marker.value not in known):
        raise BagError(
            f"The mapping does not list these markers of {episodes.topic}: {listed(unknown, _MOST_LISTED, ', ')}; put "
            "each into episodes.discard (the episode is left out) or episodes.ignore, or set start, stop, success or "
            "failure"
        )
    if found := _between_markers(markers, episodes):
        return found
    raise BagError(
        f"No marker {episodes.start!r} of {episodes.topic} is followed by {episodes.stop!r}, so there is no episode"
    )


def _words(episodes: Episodes) -> set[str]:
    """Texts of markers with a meaning."""
    words = (episodes.start, episodes.stop, episodes.success, episodes.failure)
    return {*words, *episodes.discard, *episodes.ignore}


def _between_markers(markers: list[Text], words: Episodes) -> list[Window]:
    found: list[Window] = []
    begin: int | None = None
    for marker in sorted(markers, key=lambda marker: marker.time_ns):
        if marker.value is True or marker.value == words.start:
            begin = marker.time_ns
        elif begin is not None and (
            marker.value is False or marker.value in (words.stop, words.success, words.failure)
        ):
            success = {words.success: True, words.failure: False}.get(marker.value) if marker.value else None
            found.append(Window(begin_ns=begin, end_ns=marker.time_ns, success=success))
            begin = None
        elif begin is None and found and marker.value in (words.success, words.failure):
            # The outcome may follow after the end.
            found[-1] = replace(found[-1], success=marker.value == words.success)
        elif begin is not None and marker.value in words.discard:
            found.append(Window(begin_ns=begin, end_ns=marker.time_ns, discarded=marker.value))
            begin = None
        elif found and marker.value in words.discard:
            found[-1] = replace(found[-1], discarded=marker.value)
    return found


def _feature(name: str, dtype: DTypeLike, lines: Timelines) -> Feature:
    rules = [
        f"{source.next} of the next frame"
        if source.next
        else f"{source.topic} {source.field}, {lines.lines[name, index].rule}"
        for index, source in enumerate(lines.mapping.features[name])
    ]
    streams = [lines.lines[key].stream for key, _ in lines.sources(name)]
    names = tuple(element for stream in streams for element in stream.names)
    units = (stream.unit for stream in streams for _ in stream.names)
    return imported_feature(name, dtype, names, units, called=names, source="; ".join(rules))


def _camera(name: str, plan: TakenImages, lines: Timelines) -> Camera:
    info = lines.streams.infos.get(name, {})
    matrix, distortion = _numbers(info, "k", "K"), _numbers(info, "d", "D")
    width, height = plan.head.width, plan.head.height
    fits = (info.get("width") or width, info.get("height") or height) == (width, height)
    known = fits and len(matrix) == 9 and matrix[0] > 0 and bool(np.isfinite(matrix).all())
    return Camera(
        name=name,
        width=width,
        height=height,
        kept=plan.kept,
        intrinsics=tuple(matrix) if known else None,
        distortion=tuple(distortion) if known and len(distortion) == 5 and np.isfinite(distortion).all() else (),
        source=f"{plan.topic}, {lines.lines[name].rule}",
    )


def _numbers(values: Mapping[str, Any], *keys: str) -> list[float]:
    """Numbers in the first of these fields that exists."""
    found = next((values[key] for key in keys if key in values), None)
    return [float(number) for number in found.reshape(-1)] if isinstance(found, np.ndarray) and found.size <= 64 else []


def _problems(episode: PlannedEpisode, video: VideoConfig) -> Iterator[str]:
    """Problems that prevent a recording, found before anything of the bag is written."""
    yield from find_problems(episode.info)
    for name, plan in episode.rows.cameras.items():
        if not plan.kept and (problem := size_problem(video, plan.head.width, plan.head.height)):
            yield f"camera {name}: {problem}"
    table = episode.rows.table
    for stamps in (table.time_ns, *table.stamps.values(), *table.image_stamps.values()):
        if len(stamps) and not 0 <= stamps.min() <= stamps.max() <= MAX_STAMP_NS:
            yield f"a message has the time {stamps.min() / NS:.0f} s, allowed are 0 to {MAX_STAMP_NS // NS} s"
            return


def _report(window: Window, zero_ns: int, episode: PlannedEpisode | None, reason: str) -> EpisodeReport:
    """Report a window of a bag that begins at `zero_ns`, with its episode or the reason why it has none."""
    begin_ns, end_ns, num_frames = window.begin_ns, window.end_ns, 0
    if episode:
        times = episode.rows.table.time_ns
        begin_ns, end_ns, num_frames = int(times[0]), int(times[-1]), len(times)
    return EpisodeReport(
        episode_index=episode.info.episode_index if episode else None,
        begin_s=(begin_ns - zero_ns) / NS,
        end_s=(end_ns - zero_ns) / NS,
        num_frames=num_frames,
        success=window.success,
        pictures={name: plan.described() for name, plan in episode.rows.cameras.items()} if episode else {},
        reason=reason,
        discarded=window.discarded,
        follows=episode.rows.follows if episode else "",
    )

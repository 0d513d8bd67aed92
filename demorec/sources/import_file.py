"""import.json: what a run was imported from, by which mapping, and what was found in it; kept for `check`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import ConfigError, describe_error, resource_error
from demorec.core.files import read_text_limited, replace_text
from demorec.core.plain import from_json, to_json
from demorec.runs.run_file import IMPORT_NAME
from demorec.sources.bag_files import BagError
from demorec.sources.clock import NS
from demorec.sources.findings import NOTE, Finding, lost_in
from demorec.sources.rows import EpisodeRows, Timelines


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """A stream of a bag in figures.

    Attributes:
        label, topic, type: Which it is.
        clock: Whether its times are those of headers or of recording.
        count: Messages.
        rate_hz: Of its usual distance; 0 for fewer than two messages.
        is_regular: Whether it comes at that rate, or whenever something happens.
        skew_ms: Time of recording minus that of the header, median; None without headers.
        skew_range_ms: Largest minus smallest of these, without the outer hundredth.
        jitter_ms: By how much its steps differ from the usual one, standard deviation of those without losses.
        longest_ms: Longest step.
        lost: Messages that are missing by the rate.
        duplicates: Messages of the time of another one.
        malformed: Messages that could not be used.
        max_age_ms: The oldest that any row holds.
    """

    label: str
    topic: str
    type: str
    clock: str
    count: int
    rate_hz: float
    is_regular: bool
    skew_ms: float | None
    skew_range_ms: float | None
    jitter_ms: float
    longest_ms: float
    lost: int
    duplicates: int
    malformed: int
    max_age_ms: float | None


@dataclass(frozen=True, kw_only=True)
class EpisodeReport:
    """An episode of a bag.

    Attributes:
        episode_index: In the run; None when it was dropped.
        begin_s, end_s: In the bag, from its first message on.
        num_frames: Rows.
        success: None where the bag does not say.
        trimmed_s: What of its window no row covers, at the beginning and the end.
        pictures: Camera -> what became of its images, in words.
        reason: Why it was dropped; "" for others.
        discarded: The marker that left it out, so that nothing is missing; "" for others.
        follows: Of whose messages each has a row; "" for rows of a grid.
    """

    episode_index: int | None
    begin_s: float
    end_s: float
    num_frames: int
    success: bool | None
    trimmed_s: tuple[float, float]
    pictures: dict[str, str]
    reason: str = ""
    discarded: str = ""
    follows: str = ""


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """All that is said about a bag.

    Attributes:
        name: Of the file or folder, without its place.
        files: Name and SHA-256 of each of its files.
        num_bytes: Of them.
        streams, findings, episodes: As described there.
    """

    name: str
    files: tuple[tuple[str, str], ...]
    num_bytes: int
    streams: tuple[StreamReport, ...]
    findings: tuple[Finding, ...]
    episodes: tuple[EpisodeReport, ...]

    @property
    def odd(self) -> tuple[Finding, ...]:
        """Findings that are no notes."""
        return tuple(finding for finding in self.findings if finding.kind != NOTE)


def stream_reports(lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[StreamReport]:
    """A line for each stream."""
    for line in lines.lines.values():
        stream = line.stream
        steps = np.diff(line.times_ns)
        ages = [line.chosen(rows.times_ns).reach_ns.max() for rows in episodes]
        usual = steps[(steps > 0.4 * line.period_ns) & (steps < 1.6 * line.period_ns)]
        skews = line.skews_ns
        lost = int(lost_in(line).sum()) if line.is_regular else 0
        yield StreamReport(
            label=stream.label,
            topic=stream.topic,
            type=stream.type,
            clock="header" if line.is_header else "log",
            count=len(stream),
            rate_hz=NS / line.period_ns if line.period_ns else 0.0,
            is_regular=line.is_regular,
            skew_ms=float(np.median(skews)) / 1e6 if len(skews) else None,
            skew_range_ms=float(np.ptp(np.percentile(skews, [1, 99]))) / 1e6 if len(skews) else None,
            jitter_ms=float(np.std(usual)) / 1e6 if len(usual) else 0.0,
            longest_ms=float(steps.max()) / 1e6 if len(steps) else 0.0,
            lost=lost,
            duplicates=line.num_repeated,
            malformed=stream.num_malformed,
            max_age_ms=float(max(ages)) / 1e6 if ages else None,
        )


_HEAD = ("stream", "topic", "messages", "rate Hz", "clock", "skew ms", "jitter ms", "longest ms", "lost", "age ms")
_ALIGNMENT = "<<>><>>>>>"


def report_lines(report: BagReport) -> list[str]:
    """The report as text: a table of the streams, the findings, the episodes."""
    rows = [_HEAD, *(_row(stream) for stream in report.streams)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]
    lines = [f"{report.name} ({report.num_bytes / 1e6:,.1f} MB)"]
    for row in rows:
        cells = [f"{cell:{align}{width}}" for cell, align, width in zip(row, _ALIGNMENT, widths, strict=True)]
        lines.append(f"  {'  '.join(cells)}".rstrip())
    for finding in report.findings:
        place = f"{finding.stream}: " if finding.stream else ""
        lines.append(f"  {finding.kind}: {place}{finding.text}")
    for episode in report.episodes:
        lines += _episode_lines(episode)
    return lines


def dropped_lines(report: BagReport) -> list[str]:
    """What of a bag became no episode, and how often something was odd in it."""
    lines = [line.strip() for row in report.episodes if row.episode_index is None for line in _episode_lines(row)]
    if kinds := sorted({finding.kind for finding in report.odd}):
        lines.append(f"findings in the bag ({', '.join(kinds)}), which demorec check lists")
    return lines


def _row(stream: StreamReport) -> tuple[str, ...]:
    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.1f}"

    rate = f"{stream.rate_hz:.1f}" if stream.is_regular else "on change"
    return (
        stream.label,
        stream.topic,
        str(stream.count),
        rate,
        stream.clock,
        number(stream.skew_ms),
        number(stream.jitter_ms) if stream.is_regular else "-",
        number(stream.longest_ms),
        str(stream.lost),
        number(stream.max_age_ms),
    )


def _episode_lines(episode: EpisodeReport) -> Iterator[str]:
    place = f"{episode.begin_s:.2f} to {episode.end_s:.2f} s"
    if episode.episode_index is None:
        yield f"  no episode from {place}: {episode.reason}"
        return
    verdict = {True: ", success", False: ", failure", None: ""}[episode.success]
    rows = f", one for each message of {episode.follows}" if episode.follows else ""
    yield f"  episode {episode.episode_index}: {place}, {episode.num_frames} frames{rows}{verdict}"
    for camera, text in episode.pictures.items():
        yield f"    camera {camera}: {text}"


FORMAT = 1
_MAX_BYTES = 256 << 20


@dataclass(frozen=True, kw_only=True)
class SkippedBag:
    """A bag that an import left out: the name of the file or folder, without its place, and why, in words."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImportFile:
    """The content of import.json.

    Attributes:
        format: Of this file.
        mapping: Of all bags, as plain data: that of an older release may have other keys.
        mapping_digest: Of it.
        bags: What was read, in order; those that are not whole yet are missing.
        skipped: What was left out, when it was last given.
    """

    format: int = FORMAT
    mapping: Mapping[str, Any]
    mapping_digest: str
    bags: tuple[BagReport, ...] = ()
    skipped: tuple[SkippedBag, ...] = ()

    @property
    def num_episodes(self) -> int:
        """That were made; the next one has this number."""
        return sum(episode.episode_index is not None for bag in self.bags for episode in bag.episodes)


def load_import_file(folder: Path) -> ImportFile | None:
    """That of a run; None when there is none, BagError when it cannot be read."""
    path = folder / IMPORT_NAME
    try:
        found = from_json(read_text_limited(path, _MAX_BYTES), ImportFile)
        if found.format != FORMAT:
            raise ConfigError(f"import.json has format {found.format}, this demorec knows up to {FORMAT}: {path}")
        return found
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be read ({error.strerror}): {path}"
        ) from error
    except ValueError as error:
        raise BagError(f"import.json is damaged ({describe_error(error)}): {path}") from error


def save_import_file(content: ImportFile, folder: Path) -> None:
    """Replace import.json in one step; BagError when it cannot be written."""
    path = folder / IMPORT_NAME
    try:
        replace_text(path, to_json(content, indent=2) + "\n")
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be written ({error.strerror}): {path}"
        ) from error

"""import.json: sources, mapping and findings of an import, and the checks that report them.

The bags may be gone when the run is checked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Fault, NotApplicableError, check, listed
from demorec.check.run import CheckedRun
from demorec.core.errors import ConfigError, describe_error, resource_error
from demorec.core.files import read_text_limited, replace_text
from demorec.core.plain import from_json, to_json
from demorec.extensions.imports.bag import NS
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.clock import Timeline
from demorec.extensions.imports.findings import NOTE, ImportFinding, lost_in
from demorec.extensions.imports.rows import EpisodeRows
from demorec.runs.run_file import IMPORT_NAME


@dataclass(frozen=True, kw_only=True)
class EpisodeReport:
    """Report of a part of a bag that is an episode or was dropped.

    Attributes:
        episode_index: Its number in the run; None if it was dropped.
        begin_s, end_s: Its interval in the bag, from the first message.
        num_frames: Number of rows.
        success: Outcome; None if the bag does not record it.
        pictures: Camera -> treatment of its images, in words.
        reason: Why it was dropped; "" if it was not.
        discarded: Marker that discards it, so that it does not count as missing; "" for others.
        follows: Stream with one row per message; "" for rows on a grid.
    """

    episode_index: int | None
    begin_s: float
    end_s: float
    num_frames: int
    success: bool | None
    pictures: dict[str, str]
    reason: str = ""
    discarded: str = ""
    follows: str = ""

    def lines(self) -> Iterator[str]:
        """Describe it in lines."""
        place = f"{self.begin_s:.2f} to {self.end_s:.2f} s"
        if self.episode_index is None:
            yield f"no episode from {place}: {self.reason}"
            return
        verdict = {True: ", success", False: ", failure", None: ""}[self.success]
        rows = f", one for each message of {self.follows}" if self.follows else ""
        yield f"episode {self.episode_index}: {place}, {self.num_frames} frames{rows}{verdict}"
        for camera, text in self.pictures.items():
            yield f"  camera {camera}: {text}"


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """Report of a bag.

    Attributes:
        name: Name of the file or folder, without its path.
        files: Name and SHA-256 of each of its files.
        num_bytes: Size of its files.
        streams: Figures of each stream, from `stream_figures`.
        findings, episodes: See these classes.
    """

    name: str
    files: tuple[tuple[str, str], ...]
    num_bytes: int
    streams: tuple[dict[str, str], ...]
    findings: tuple[ImportFinding, ...]
    episodes: tuple[EpisodeReport, ...]

    @property
    def made(self) -> tuple[EpisodeReport, ...]:
        """Episodes that were not dropped."""
        return tuple(episode for episode in self.episodes if episode.episode_index is not None)

    @property
    def odd(self) -> tuple[ImportFinding, ...]:
        """Findings except notes."""
        return tuple(finding for finding in self.findings if finding.kind != NOTE)

    def dropped_lines(self) -> Iterator[str]:
        """Describe dropped parts and findings."""
        for episode in self.episodes:
            if episode.episode_index is None:
                yield from episode.lines()
        if kinds := sorted({finding.kind for finding in self.odd}):
            yield f"findings in the bag ({', '.join(kinds)}), which demorec check lists"


def stream_figures(line: Timeline, episodes: Sequence[EpisodeRows]) -> dict[str, str]:
    """Return the figures of a stream by their column in the report's table.

    The skew is the median of log time minus header time, the jitter the deviation of the steps without lost messages,
    the age that of the oldest message in any row, and unused messages are in no row.
    """
    steps = np.diff(line.times_ns)
    usual = steps[(steps > 0.4 * line.period_ns) & (steps < 1.6 * line.period_ns)]
    chosen = [line.chosen(rows.table.time_ns) for rows in episodes]
    ages = [choice.age_ns.max() for choice in chosen]
    return {
        "stream": line.stream.label,
        "topic": line.stream.topic,
        "messages": str(len(line.stream)),
        "rate Hz": f"{NS / line.period_ns:.1f}" if line.is_regular else "on change",
        "clock": "header" if line.is_header else "log",
        "skew ms": f"{np.median(line.skews_ns) / 1e6:.1f}" if len(line.skews_ns) else "-",
        "jitter ms": f"{np.std(usual) / 1e6:.1f}" if line.is_regular else "-",
        "longest ms": f"{steps.max(initial=0) / 1e6:.1f}",
        "lost": str(int(lost_in(line).sum()) if line.is_regular else 0),
        "age ms": f"{max(ages) / 1e6:.1f}" if ages else "-",
        "unused": str(sum(int(np.ptp(choice.index)) + 1 - len(np.unique(choice.index)) for choice in chosen)),
    }


FORMAT = 1
_MAX_BYTES = 256 << 20


@dataclass(frozen=True, kw_only=True)
class SkippedBag:
    """A bag that an import left out: the name of the file or folder, without its path, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImportFile:
    """The content of import.json.

    Attributes:
        format: Format version of this file.
        mapping: Mapping of all bags, as plain data; one from an older release may have other keys.
        mapping_digest: Its digest.
        bags: Reports of the imported bags in order, without unfinished ones.
        skipped: Bags left out when they were last given.
    """

    format: int = FORMAT
    mapping: Mapping[str, Any]
    mapping_digest: str
    bags: tuple[BagReport, ...] = ()
    skipped: tuple[SkippedBag, ...] = ()

    @property
    def num_episodes(self) -> int:
        """Number of imported episodes, which is also the number of the next one."""
        return sum(len(bag.made) for bag in self.bags)


def load_import_file(folder: Path) -> ImportFile | None:
    """Load the import.json of a run; None if it has none, BagError if it cannot be read."""
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
    """Replace import.json atomically; BagError if it cannot be written."""
    path = folder / IMPORT_NAME
    try:
        replace_text(path, to_json(content, indent=2) + "\n")
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be written ({error.strerror}): {path}"
        ) from error


_MAX_LISTED = 5

import_check = partial(
    check,
    family="files",
    on=("external run",),
    needs="an imported run",
    why="Data is missing from the run, or has the wrong time.",
    do="look at it: demorec view {path}",
)


@import_check(measures="findings of the import about clocks and losses")
def import_findings(run: CheckedRun) -> Iterator[Fault]:
    """List the findings of the import."""
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in _import_file(run).bags
        for finding in bag.odd
    ]
    return listed(words, "look", _MAX_LISTED)


@import_check(measures="episodes that an import dropped, skipped files")
def import_dropped(run: CheckedRun) -> Iterator[Fault]:
    """List the episodes of the imported files that are not in the run, except those that a marker discards."""
    found = _import_file(run)
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return listed(dropped, "look", _MAX_LISTED)


def _import_file(run: CheckedRun) -> ImportFile:
    if (found := load_import_file(run.path)) is None:
        raise NotApplicableError("the run was not imported")
    return found

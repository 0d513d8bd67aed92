"""import.json: sources, mapping and findings of an import, and the check that reports them.

The bags may be gone when the run is checked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from demorec.check.base import Fault, NotApplicableError, check, listed
from demorec.check.run import CheckedRun
from demorec.core.errors import describe_error, resource_error
from demorec.core.files import read_text_limited, replace_text
from demorec.core.plain import from_plain, parse_json, to_json
from demorec.extensions.imports.bag import NS
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.clock import Int, Timeline
from demorec.extensions.imports.findings import NOTE, ImportFinding, lost_in
from demorec.runs.run_file import IMPORT_NAME


@dataclass(frozen=True, kw_only=True)
class BagReport:
    """Report of a bag and its episode.

    Attributes:
        name: Name of the file or folder, without its path.
        files: Name and SHA-256 of each of its files.
        num_bytes: Size of its files.
        streams: Figures of each stream, from `stream_figures`.
        findings: See this class.
        episode_index: Number of the episode in the run.
        begin_s, end_s: Interval of its rows in the bag, from the first message.
        num_frames: Number of rows.
        pictures: Camera -> treatment of its images, in words.
        follows: Stream with one row per message; "" for rows on a grid.
    """

    name: str
    files: tuple[tuple[str, str], ...]
    num_bytes: int
    streams: tuple[dict[str, str], ...]
    findings: tuple[ImportFinding, ...]
    episode_index: int
    begin_s: float
    end_s: float
    num_frames: int
    pictures: dict[str, str]
    follows: str

    @property
    def odd(self) -> tuple[ImportFinding, ...]:
        """Findings except notes."""
        return tuple(finding for finding in self.findings if finding.kind != NOTE)

    def episode_lines(self) -> Iterator[str]:
        """Describe the episode in lines."""
        place = f"{self.begin_s:.2f} to {self.end_s:.2f} s"
        rows = f", one for each message of {self.follows}" if self.follows else ""
        yield f"episode {self.episode_index}: {place}, {self.num_frames} frames{rows}"
        for camera, text in self.pictures.items():
            yield f"  camera {camera}: {text}"


def stream_figures(line: Timeline, rows_ns: Int) -> dict[str, str]:
    """Return the figures of a stream by their column in the report's table.

    The skew is the median of log time minus header time, the age that of the oldest message in any row, and unused
    messages are in no row.
    """
    chosen = line.chosen(rows_ns)
    return {
        "stream": line.stream.label,
        "topic": line.stream.topic,
        "messages": str(len(line.stream)),
        "rate Hz": f"{NS / line.period_ns:.1f}" if line.is_regular else "on change",
        "clock": "header" if line.is_header else "log",
        "skew ms": f"{np.median(line.skews_ns) / 1e6:.1f}" if len(line.skews_ns) else "-",
        "lost": str(int(lost_in(line).sum()) if line.is_regular else 0),
        "age ms": f"{chosen.age_ns.max() / 1e6:.1f}",
        "unused": str(int(np.ptp(chosen.index)) + 1 - len(np.unique(chosen.index))),
    }


FORMAT = 2
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


def load_import_file(folder: Path) -> ImportFile | None:
    """Load the import.json of a run; None if it has none, BagError if it cannot be read."""
    path = folder / IMPORT_NAME
    try:
        plain = parse_json(read_text_limited(path, _MAX_BYTES))
        if isinstance(plain, dict) and plain.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}, import the bags again")
        return from_plain(plain, ImportFile)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be read ({error.strerror}): {path}"
        ) from error
    except ValueError as error:
        raise BagError(f"import.json cannot be used ({describe_error(error)}): {path}") from error


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


@check(
    family="files",
    on=("external run",),
    measures="findings of an import about clocks and losses, and files that it left out",
    needs="an imported run",
    why="Data is missing from the run, or has the wrong time.",
    do="look at it: demorec view {path}",
)
def import_findings(run: CheckedRun) -> Iterator[Fault]:
    """List the findings of the import, and the files that were given to it and are not in the run."""
    if (found := load_import_file(run.path)) is None:
        raise NotApplicableError("the run was not imported")
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in found.bags
        for finding in bag.odd
    ]
    words += [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return listed(words, "look", _MAX_LISTED)

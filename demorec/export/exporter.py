"""What an exporter is: a row of `demorec.tables.EXPORTERS`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from demorec.export.options import CommonOptions, ExportReport, ProgressCallback


@dataclass(frozen=True, kw_only=True)
class Exporter[O: CommonOptions]:
    """A format that recordings are exported to.

    Its module is loaded for `--help`, so `export` imports what is heavy when it is called.

    Attributes:
        summary: What comes out, in one line.
        options: Its flags; a dataclass with a docstring below each field.
        export: (sources, out, options, progress) -> report. Reads `Recording`s and nothing else, takes those that
            `demorec.export.sources` finds, and makes `out` whole or not at all. Raises ConfigError, ExportError and
            RecordingError.
    """

    summary: str
    options: type[O]
    export: Callable[[Sequence[Path], Path, O, ProgressCallback | None], ExportReport]

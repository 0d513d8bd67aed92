"""What an exporter is: a row of `demorec.core.tables.EXPORTERS`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from demorec.datasets.options import CommonOptions, ExportReport, ProgressCallback


@dataclass(frozen=True, kw_only=True)
class Exporter[O: CommonOptions]:
    """A format that recordings are exported to.

    Its module is loaded for `--help`, so what is heavy is imported when `export` is called.

    Attributes:
        summary: What comes out, in one line.
        options: Its flags; a dataclass with a docstring below each field.
        function: "module:name" of (sources, out, options, progress) -> report. It reads recordings and nothing else,
            takes those that `demorec.datasets.sources` finds, and makes `out` whole or not at all. Raises ConfigError,
            ExportError and RecordingError.
    """

    summary: str
    options: type[O]
    function: str

    def export(self, sources: Sequence[Path], out: Path, options: O, progress: ProgressCallback | None) -> ExportReport:
        """Call it."""
        module, _, name = self.function.partition(":")
        report: ExportReport = getattr(importlib.import_module(module), name)(sources, out, options, progress)
        return report

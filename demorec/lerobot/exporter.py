"""LeRobot's row in the table of exporters; loaded for `--help`, so that nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from demorec.export.exporter import Exporter
from demorec.export.options import ExportReport, ProgressCallback
from demorec.lerobot.options import ExportOptions


def _export(
    sources: Sequence[Path], out: Path, options: ExportOptions, progress: ProgressCallback | None
) -> ExportReport:
    from demorec.lerobot.export import export_lerobot

    return export_lerobot(sources, out, options, progress)


LEROBOT = Exporter(
    summary="LeRobot v3.0, a folder: recorded video as it is, numbers bit for bit, statistics, card",
    options=ExportOptions,
    export=_export,
)

"""LeRobot's row in the table of exporters; loaded for `--help`, so that nothing heavy is imported here."""

from __future__ import annotations

from demorec.export.exporter import Exporter
from demorec.lerobot.options import ExportOptions

LEROBOT = Exporter(
    summary="LeRobot v3.0, a folder: recorded video as it is, numbers bit for bit, statistics, card",
    options=ExportOptions,
    function="demorec.lerobot.export:export_lerobot",
)

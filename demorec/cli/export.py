"""`demorec export`: recordings to a dataset."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from demorec.cli.output import say
from demorec.cli.progress import ProgressBar
from demorec.errors import ConfigError
from demorec.export.options import ExportOptions, ExportReport


@dataclass(frozen=True, kw_only=True)
class Export:
    """Turn recordings into a LeRobot v3.0 dataset, without coding a picture anew.

    Each recorded video packet goes into the dataset as it is, each number bit for bit. The dataset appears whole or
    not at all; the recordings are never touched.

    Examples:
      demorec export lerobot recordings/cubes --out cubes --repo-id me/cubes
      demorec export lerobot run_a run_b --out both --action joint_increment
      demorec export lerobot recordings/cubes --out cubes --append --episodes 100:
      demorec export lerobot recordings/cubes --out slow --fps 10
    """

    format: Positional[Literal["lerobot"]]
    """Of the dataset."""
    sources: Positional[tuple[Path, ...]]
    """Runs, recordings, or folders of recordings."""
    out: Path
    """Folder of the dataset."""
    options: Annotated[ExportOptions, arg(name="")] = field(default_factory=ExportOptions)
    """How."""

    def run(self) -> int:
        """Export and say what came out."""
        if not self.sources:
            raise ConfigError("No recordings are given: name a run, e.g. demorec export lerobot recordings/cubes.")
        from demorec.export.lerobot import export_lerobot

        with ProgressBar("exporting") as bar:
            report = export_lerobot(self.sources, self.out, self.options, bar.set)
        say(*_told(report))
        return 0


def _told(report: ExportReport) -> list[str]:
    added = f", {report.new_episodes} of them new" if report.new_episodes != report.num_episodes else ""
    lines = [f"{report.num_episodes} episodes, {report.num_frames} frames{added}: {report.path}"]
    if report.skipped_failures:
        lines.append(f"{report.skipped_failures} failed attempts left out (--include-failures takes them).")
    if report.left_out:
        lines.append(f"Left out, since the dataset does not have them: {', '.join(report.left_out)}.")
    lines += [f"Pictures coded anew: camera {what}." for what in report.transcoded]
    if report.verified_frames:
        lines.append(f"Verified: {report.verified_frames} frames read through LeRobot equal the recordings.")
    if report.not_verified:
        lines.append(f"Not verified: {report.not_verified}")
    lines.append(f"Content digest: {report.digest}")
    if report.url:
        lines.append(f"Uploaded to {report.url}")
    return lines

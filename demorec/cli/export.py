"""`demorec export`: export recordings to a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from tyro.conf import Positional, arg
from tyro.constructors import MISSING_NONPROP

from demorec.cli.shared.output import ProgressBar, counted, say
from demorec.cli.shared.paths import MappingFile, Readable, reading, refuse_inside, tell_incomplete
from demorec.core.errors import ConfigError
from demorec.core.options import Rare
from demorec.core.replacing import Target
from demorec.core.tables import EXPORTERS
from demorec.datasets.options import CommonOptions, ExportReport


@dataclass(frozen=True, kw_only=True)
class Export:
    """Export recordings to a dataset.

    The dataset appears complete or not at all; the recordings are never changed. The flags below apply to every format;
    put a format before --help to see its own flags as well. `demorec list exporters` describes the formats.

    Examples:
      demorec export lerobot recordings/cubes --out cubes --repo-id me/cubes
      demorec export lerobot run_a run_b --out both --action joint_increment
      demorec export lerobot recordings/cubes --out cubes --append --episodes 100:
      demorec export hdf5 recordings/cubes --out cubes.hdf5 --action ee_delta
    """

    format: Annotated[Positional[str], arg(metavar="FORMAT", help=f"One of: {', '.join(EXPORTERS.names())}.")]
    sources: Readable
    out: Target
    """Folder or file to create."""
    mapping: Rare[MappingFile] = None
    options: Annotated[CommonOptions, arg(name="")] = field(default_factory=CommonOptions)
    """Options of the export."""

    @classmethod
    def defaults(cls, args: Sequence[str]) -> Export:
        """Return the options of the format that the command line names."""
        required: Any = MISSING_NONPROP
        name = next((arg for arg in args if arg in EXPORTERS.rows), None)
        options = CommonOptions() if name is None else EXPORTERS.load(name).options()
        return cls(format=required, sources=required, out=required, options=options)

    def run(self) -> int:
        """Export and print a summary."""
        exporter = EXPORTERS.load(self.format)
        if type(self.options) is not exporter.options:
            raise ConfigError(f"The format must come first: demorec export {self.format} ...")
        if not self.sources:
            raise ConfigError(
                f"No recordings are given: name a run, e.g. demorec export {self.format} recordings/cubes."
            )
        refuse_inside([self.out])
        tell_incomplete(self.sources)
        with (
            reading(self.sources, self.mapping, imports_datasets=True) as sources,
            ProgressBar("exporting") as bar,
        ):
            report = exporter.export(sources, self.out, self.options, bar.set)
        say(*_summary_lines(report))
        return 0


def _summary_lines(report: ExportReport) -> Iterator[str]:
    added = f", {report.new_episodes} of them new" if report.new_episodes != report.num_episodes else ""
    yield f"{counted(report.num_episodes, 'episode')}, {report.num_frames} frames{added}: {report.path}"
    if report.skipped_failures:
        skipped = counted(report.skipped_failures, "failed or unfinished attempt")
        yield f"{skipped} left out (taken with --include-failures)."
    if report.skipped_unwanted:
        yield f"{counted(report.skipped_unwanted, 'recording')} left out by --episodes or --corrected-only."
    if report.left_out:
        yield f"Left out, since the dataset does not have them: {', '.join(report.left_out)}."
    if report.depth_left_out:
        yield f"Depth images are left out without --depth: camera {', '.join(report.depth_left_out)}."
    yield from (f"Images re-encoded: camera {what}." for what in report.transcoded)
    if report.verified_frames:
        yield f"Verified: {report.verified_frames} frames read through LeRobot equal the recordings."
    if report.not_verified:
        yield f"Not verified: {report.not_verified}"
    if report.digest:
        yield f"Content digest: {report.digest}"
    if report.url:
        yield f"Uploaded to {report.url}"

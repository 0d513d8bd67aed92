"""HDF5's row in the table of exporters; loaded for `--help`, so that nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from demorec.export.exporter import Exporter
from demorec.export.options import ExportReport, ProgressCallback
from demorec.hdf5.options import Hdf5Options


def _export(
    sources: Sequence[Path], out: Path, options: Hdf5Options, progress: ProgressCallback | None
) -> ExportReport:
    from demorec.hdf5.export import export_hdf5

    return export_hdf5(sources, out, options, progress)


HDF5 = Exporter(
    summary="robomimic's layout, one HDF5 file: decoded pictures, the same numbers, masks for training and validation",
    options=Hdf5Options,
    export=_export,
)

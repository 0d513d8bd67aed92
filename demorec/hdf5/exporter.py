"""HDF5's row in the table of exporters; loaded for `--help`, so that nothing heavy is imported here."""

from __future__ import annotations

from demorec.export.exporter import Exporter
from demorec.hdf5.options import Hdf5Options

HDF5 = Exporter(
    summary="robomimic's layout, one HDF5 file: decoded pictures, the same numbers, masks for training and validation",
    options=Hdf5Options,
    function="demorec.hdf5.export:export_hdf5",
)

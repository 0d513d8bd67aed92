"""Declaration of the export to HDF5."""

from __future__ import annotations

from demorec.core.extension import Extension

EXTENSION = Extension(
    name="hdf5",
    summary="export HDF5 files in robomimic's layout",
    exporters={"hdf5": "demorec.extensions.hdf5.options:HDF5"},
)

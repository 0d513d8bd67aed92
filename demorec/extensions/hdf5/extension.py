"""Declaration of the export to HDF5."""

from demorec.core.extension import ExporterRow, Extension

EXTENSION = Extension(
    name="hdf5",
    summary="export HDF5 files in robomimic's layout",
    exporters={"hdf5": ExporterRow(target="demorec.extensions.hdf5.options:HDF5")},
)

"""Declaration of the import of bags, HDF5 files and LeRobot datasets."""

from __future__ import annotations

from demorec.core.extension import CommandRow, Extension, ReaderRow

EXTENSION = Extension(
    name="imports",
    summary="convert bags, HDF5 files and LeRobot datasets to runs",
    commands={"import": CommandRow(target="demorec.extensions.imports.command:Import", group="make", limits="reading")},
    readers={
        "rosbag": ReaderRow(
            target="demorec.extensions.imports.formats:BAGS",
            name="a bag of another program",
            plural="bags",
            advice="demorec import converts it to a run",
        ),
        "dataset": ReaderRow(
            target="demorec.extensions.imports.formats:DATASETS",
            name="a LeRobot dataset",
            plural="LeRobot datasets",
            word="lerobot",
        ),
        "hdf5": ReaderRow(
            target="demorec.extensions.imports.formats:HDF5",
            name="an HDF5 file",
            plural="HDF5 files",
            word="hdf5",
            advice="name the run that it was made from, or convert it to one (demorec import hdf5)",
        ),
    },
    file_checks={
        "import_findings": "demorec.extensions.imports.checks:import_findings",
        "import_dropped": "demorec.extensions.imports.checks:import_dropped",
    },
)

"""Declaration of the import of bags, HDF5 files and LeRobot datasets."""

from demorec.core.extension import CommandRow, Extension, ReaderRow

EXTENSION = Extension(
    name="imports",
    summary="convert bags, HDF5 files and LeRobot datasets to runs",
    needs=("datasets", "recorder", "recovery"),
    commands={"import": CommandRow(target="demorec.extensions.imports.command:Import", group="make", limits="reading")},
    readers={
        "rosbag": ReaderRow(
            name="a bag of another program",
            plural="bags",
            advice="demorec import converts it to a run",
            example="monday.mcap --mapping robot.toml --out runs/robot",
            importer="demorec.extensions.imports.import_run:import_bags",
            suggester="demorec.extensions.imports.suggest:suggested_mapping",
            describer="demorec.extensions.imports.describe:describe_bags",
            dropped="demorec.extensions.imports.describe:dropped_rows",
        ),
        "dataset": ReaderRow(
            name="a LeRobot dataset",
            plural="LeRobot datasets",
            word="lerobot",
            example="datasets/cups --out runs/cups",
            importer="demorec.extensions.imports.dataset_import:import_lerobot",
        ),
        "hdf5": ReaderRow(
            name="an HDF5 file",
            plural="HDF5 files",
            word="hdf5",
            advice="name the run that it was made from, or convert it to one (demorec import hdf5)",
            example="demo.hdf5 --mapping mapping.toml --out runs/demo",
            importer="demorec.extensions.imports.hdf5_import:import_hdf5",
            suggester="demorec.extensions.imports.hdf5_suggest:suggested_hdf5_mapping",
            describer="demorec.extensions.imports.describe:describe_hdf5",
        ),
    },
    file_checks={"import_findings": "demorec.extensions.imports.import_file:import_findings"},
)

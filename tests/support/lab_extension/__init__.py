"""A third-party package that adds one item of every kind to demorec."""

from demorec.api import CommandRow, ExporterRow, Extension, ExtraFilesRow, ReaderRow

EXTENSION = Extension(
    name="lab",
    summary="what our lab uses",
    needs=("doctor",),
    commands={"count-frames": CommandRow(target="lab_extension.commands:CountFrames", group="look", limits="reading")},
    readers={
        "labcsv": ReaderRow(
            name="a CSV file of our lab",
            plural="CSV files of our lab",
            advice="make a run of it (demorec import labcsv)",
            word="labcsv",
            suffixes=(".labcsv",),
            example="cup.labcsv --out runs/cup",
            importer="lab_extension.csv_files:import_files",
        )
    },
    exporters={"labcsv": ExporterRow(target="lab_extension.csv_files:EXPORTER")},
    statements={"motto": "lab_extension.words:mottoes"},
    extra_files={
        "frame_counts": ExtraFilesRow(target="lab_extension.words:FrameCounts", help="Write the episodes' lengths.")
    },
    tasks={"lab_pick": "lab_extension.scenes:LabPick"},
    robots={"lab_panda": "lab_extension.scenes:LAB_PANDA"},
    cameras={"corner": "lab_extension.scenes:CORNER"},
    executors={"bench": "lab_extension.machines:bench"},
    checks={"late_start": "lab_extension.checks:late_start"},
)

"""Declaration of the report."""

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="report",
    summary="one page about a run or a dataset",
    needs=("datasets", "doctor", "policies"),
    commands={
        "report": CommandRow(target="demorec.extensions.report.command:ReportCommand", group="look", limits="reading")
    },
)

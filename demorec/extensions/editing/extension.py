"""Declaration of the dataset editing."""

from __future__ import annotations

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="editing",
    summary="edit, cut, repair and compare LeRobot datasets",
    commands={
        "dataset": CommandRow(
            target="demorec.extensions.editing.command:DatasetCommand", group="edit", limits="reading"
        )
    },
    operations={
        "select": "demorec.extensions.editing.selection:Select",
        "drop": "demorec.extensions.editing.selection:Drop",
        "trim": "demorec.extensions.editing.operations:Trim",
        "cut": "demorec.extensions.editing.operations:Cut",
        "split": "demorec.extensions.editing.selection:Split",
        "merge": "demorec.extensions.editing.operations:Merge",
        "rename": "demorec.extensions.editing.operations:Rename",
        "drop-features": "demorec.extensions.editing.operations:DropFeatures",
        "set-task": "demorec.extensions.editing.selection:SetTask",
        "reorder": "demorec.extensions.editing.selection:Reorder",
        "shuffle": "demorec.extensions.editing.selection:Shuffle",
        "repair": "demorec.extensions.editing.operations:Repair",
        "diff": "demorec.extensions.editing.operations:Diff",
    },
)

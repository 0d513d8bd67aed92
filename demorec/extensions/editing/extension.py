"""Declaration of the dataset editing."""

from __future__ import annotations

from demorec.core.extension import CommandRow, Extension

EXTENSION = Extension(
    name="editing",
    summary="edit, cut, repair and compare LeRobot datasets",
    commands={
        "dataset": CommandRow(
            target="demorec.extensions.editing.commands:DatasetCommand", group="edit", limits="reading"
        )
    },
    operations={
        "select": "demorec.extensions.editing.commands.operations:Select",
        "drop": "demorec.extensions.editing.commands.operations:Drop",
        "trim": "demorec.extensions.editing.commands.operations:Trim",
        "cut": "demorec.extensions.editing.commands.damage:Cut",
        "split": "demorec.extensions.editing.commands.operations:Split",
        "merge": "demorec.extensions.editing.commands.operations:Merge",
        "rename": "demorec.extensions.editing.commands.operations:Rename",
        "drop-features": "demorec.extensions.editing.commands.operations:DropFeatures",
        "set-task": "demorec.extensions.editing.commands.operations:SetTask",
        "reorder": "demorec.extensions.editing.commands.operations:Reorder",
        "shuffle": "demorec.extensions.editing.commands.operations:Shuffle",
        "repair": "demorec.extensions.editing.commands.damage:Repair",
        "diff": "demorec.extensions.editing.commands.diff:Diff",
    },
)

"""`demorec dataset`: the commands that edit and compare LeRobot datasets, whoever wrote them."""

from __future__ import annotations

from typing import Any

from demorec.core.registry import Registry


class DatasetCommand:
    """Edit LeRobot datasets: no image is encoded again, the sources stay as they are.

    Any LeRobot dataset (v3.0, v2.1) is read; a run stands for its own dataset. The result appears whole or not at all.
    """

    commands: Registry[Any] = Registry(
        kind="command of demorec dataset",
        rows={
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

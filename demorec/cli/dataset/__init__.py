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
            "select": "demorec.cli.dataset.operations:Select",
            "drop": "demorec.cli.dataset.operations:Drop",
            "trim": "demorec.cli.dataset.operations:Trim",
            "cut": "demorec.cli.dataset.damage:Cut",
            "split": "demorec.cli.dataset.operations:Split",
            "merge": "demorec.cli.dataset.operations:Merge",
            "rename": "demorec.cli.dataset.operations:Rename",
            "drop-features": "demorec.cli.dataset.operations:DropFeatures",
            "set-task": "demorec.cli.dataset.operations:SetTask",
            "reorder": "demorec.cli.dataset.operations:Reorder",
            "shuffle": "demorec.cli.dataset.operations:Shuffle",
            "repair": "demorec.cli.dataset.damage:Repair",
            "diff": "demorec.cli.dataset.diff:Diff",
        },
    )

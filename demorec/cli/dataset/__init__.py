"""`demorec dataset`: the commands that edit, compare and score LeRobot datasets, whoever wrote them."""

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
            "select": "demorec.cli.dataset.select:Select",
            "drop": "demorec.cli.dataset.select:Drop",
            "trim": "demorec.cli.dataset.trim:Trim",
            "split": "demorec.cli.dataset.split:Split",
            "merge": "demorec.cli.dataset.merge:Merge",
            "rename": "demorec.cli.dataset.features:Rename",
            "drop-features": "demorec.cli.dataset.features:DropFeatures",
            "set-task": "demorec.cli.dataset.set_task:SetTask",
            "reorder": "demorec.cli.dataset.order:Reorder",
            "shuffle": "demorec.cli.dataset.order:Shuffle",
            "diff": "demorec.cli.dataset.diff:Diff",
            "score": "demorec.cli.dataset.score:Score",
        },
    )

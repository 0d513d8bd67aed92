"""`demorec dataset`: the commands that edit and compare LeRobot datasets, whoever wrote them."""

from __future__ import annotations

from typing import Any

from demorec.core.extensions import ExtensionRows
from demorec.core.registry import Registry


class DatasetCommand:
    """Edit LeRobot datasets: no image is encoded again, the sources stay as they are.

    Any LeRobot dataset (v3.0, v2.1) is read; a run stands for its own dataset. The result appears whole or not at all.
    """

    commands: Registry[Any] = Registry(kind="command of demorec dataset", rows=ExtensionRows("operations"))

"""`demorec dataset`: commands that edit and compare LeRobot datasets from any writer."""

from __future__ import annotations

from typing import Any

from demorec.core.extension import targets_of
from demorec.core.registry import Registry


class DatasetCommand:
    """Edit LeRobot datasets without re-encoding images or changing the sources.

    Reads any LeRobot dataset (v3.0, v2.1); a run means its own dataset. The result appears complete or not at all.
    """

    commands: Registry[Any] = Registry(kind="command of demorec dataset", rows=targets_of("operations"))

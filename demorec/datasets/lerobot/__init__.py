"""LeRobot v3.0: recordings to datasets, and datasets read, whoever wrote them.

`export_lerobot` makes one; `dataset_digest` says what is in one. The names are
imported when they are used, so that a command's --help need not wait for PyArrow and PyAV.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.datasets.lerobot.export import export_lerobot
    from demorec.datasets.lerobot.inspect import dataset_digest
    from demorec.datasets.lerobot.options import ExportOptions
    from demorec.datasets.lerobot.paths import is_dataset
    from demorec.datasets.options import ExportReport, ProgressCallback

_HOMES = {
    "ExportOptions": "demorec.datasets.lerobot.options",
    "ExportReport": "demorec.datasets.options",
    "ProgressCallback": "demorec.datasets.options",
    "dataset_digest": "demorec.datasets.lerobot.inspect",
    "export_lerobot": "demorec.datasets.lerobot.export",
    "is_dataset": "demorec.datasets.lerobot.paths",
}
__all__ = ["ExportOptions", "ExportReport", "ProgressCallback", "dataset_digest", "export_lerobot", "is_dataset"]


def __getattr__(name: str) -> Any:
    import importlib

    if name not in _HOMES:
        raise AttributeError(name)
    return getattr(importlib.import_module(_HOMES[name]), name)

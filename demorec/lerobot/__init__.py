"""LeRobot v3.0: recordings to datasets, and datasets read, whoever wrote them.

`export_lerobot` makes one; `dataset_info` and `dataset_digest` tell what is in one. The names are
imported when they are used, so that a command's --help need not wait for PyArrow and PyAV.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.export.options import ExportReport, ProgressCallback
    from demorec.lerobot.export import export_lerobot
    from demorec.lerobot.inspect import DatasetSummary, dataset_digest, dataset_info
    from demorec.lerobot.options import ExportOptions
    from demorec.lerobot.paths import is_dataset

__all__ = [
    "DatasetSummary",
    "ExportOptions",
    "ExportReport",
    "ProgressCallback",
    "dataset_digest",
    "dataset_info",
    "export_lerobot",
    "is_dataset",
]

_HOMES = {
    "export_lerobot": "demorec.lerobot.export",
    "ExportOptions": "demorec.lerobot.options",
    "ExportReport": "demorec.export.options",
    "ProgressCallback": "demorec.export.options",
    "is_dataset": "demorec.lerobot.paths",
}


def __getattr__(name: str) -> Any:
    import importlib

    if name not in __all__:
        raise AttributeError(name)
    return getattr(importlib.import_module(_HOMES.get(name, "demorec.lerobot.inspect")), name)

"""Recordings to datasets that others train on: LeRobot v3.0.

`export_lerobot` makes one; `dataset_info` and `dataset_digest` tell what is in one, whoever wrote it. The names are
imported when they are used, so that a command's --help need not wait for PyArrow and PyAV.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.export.inspect import DatasetSummary, dataset_digest, dataset_info, is_dataset
    from demorec.export.lerobot import export_lerobot
    from demorec.export.options import ExportOptions, ExportReport, Progress

__all__ = [
    "DatasetSummary",
    "ExportOptions",
    "ExportReport",
    "Progress",
    "dataset_digest",
    "dataset_info",
    "export_lerobot",
    "is_dataset",
]

_HOMES = {"export_lerobot": "lerobot", "ExportOptions": "options", "ExportReport": "options", "Progress": "options"}


def __getattr__(name: str) -> Any:
    import importlib

    if name not in __all__:
        raise AttributeError(name)
    return getattr(importlib.import_module(f"demorec.export.{_HOMES.get(name, 'inspect')}"), name)

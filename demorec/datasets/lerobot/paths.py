"""Names that a LeRobot dataset is known by; a module of its own, so that asking needs no PyArrow."""

from __future__ import annotations

from pathlib import Path

INFO_PATH = "meta/info.json"
CARD_PATH = "README.md"
SIDECAR_DIR = "demorec"
"""Folder inside the dataset for what LeRobot has no place for."""


def is_dataset(path: Path) -> bool:
    """Whether a folder looks like a LeRobot dataset."""
    return (path / INFO_PATH).is_file()

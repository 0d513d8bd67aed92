"""File names that identify a LeRobot dataset; a separate module so that checking needs no PyArrow."""

from __future__ import annotations

import re
from pathlib import Path

from demorec.core.replacing import ReplaceableKind, files_below, json_object

INFO_PATH = "meta/info.json"
CARD_PATH = "README.md"
SIDECAR_DIR = "demorec"
"""Folder inside the dataset for data without a place in LeRobot's format."""
BOXES_DIR = f"{SIDECAR_DIR}/boxes"
PROGRESS_PATH = "sarm_progress.parquet"


def is_dataset(path: Path) -> bool:
    """Whether a folder looks like a LeRobot dataset."""
    return (path / INFO_PATH).is_file()


_NUMBERED = r"(file-\d+|episode_\d+)"
_PARTS = re.compile(
    r"meta/(info|stats|modality|temporal_proportions_\w+)\.json"
    r"|sarm_progress\.parquet"
    r"|meta/tasks\.parquet"
    r"|meta/(tasks|episodes|episodes_stats)\.jsonl"
    rf"|meta/episodes/chunk-\d+/{_NUMBERED}\.parquet"
    rf"|data/chunk-\d+/{_NUMBERED}\.parquet"
    rf"|videos/[^/]+/chunk-\d+/{_NUMBERED}\.mp4"
    rf"|videos/chunk-\d+/[^/]+/{_NUMBERED}\.mp4"
    r"|images/[^/]+/episode[-_]\d+/frame[-_]\d+\.(png|jpe?g|tiff?)"
    rf"|{SIDECAR_DIR}/episodes/chunk-\d+/file-\d+\.parquet"
    rf"|{SIDECAR_DIR}/boxes/[^/]+\.json"
    rf"|{SIDECAR_DIR}/robots/[0-9a-f]{{16}}\.(json|urdf)"
    rf"|{SIDECAR_DIR}/(configs|export)\.json"
    r"|README\.md|\.gitattributes|\.cache/huggingface/.*"
)
"""Files of a dataset in LeRobot's formats 2.0 to 3.0, including demorec's, GR00T's and the Hub's."""


def _is_dataset(folder: Path) -> bool:
    info = json_object(folder / INFO_PATH)
    return isinstance(info.get("codebase_version"), str) and isinstance(info.get("features"), dict)


def is_dataset_file(name: str) -> bool:
    """Whether a file name, relative to the dataset's folder, belongs to a dataset."""
    return _PARTS.fullmatch(name) is not None


def _strangers(folder: Path) -> list[str]:
    return [name for name in files_below(folder) if not is_dataset_file(name) or (folder / name).is_dir()]


DATASET = ReplaceableKind(
    name="a LeRobot dataset",
    is_folder=True,
    recognises=_is_dataset,
    strangers=_strangers,
    advice="choose --append, --overwrite or another --out",
)


def _unlinkable(folder: Path) -> list[str]:
    return [name for name in files_below(folder) if not (folder / name).is_file()]


GROWING_DATASET = ReplaceableKind(name=DATASET.name, is_folder=True, recognises=_is_dataset, strangers=_unlinkable)
"""A dataset to append to: all its files are kept, from any writer; links to folders and devices cannot be."""

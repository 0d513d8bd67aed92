"""What is read by importing it: a row a format, and `demorec import` and whatever else reads go by the rows.

Bags have none: `demorec.sources.bag` tells their kinds apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.robots.motors import Motors
from demorec.runs.find import IMPORT_WORDS, PathKind
from demorec.sources.mapping import SourceKind

if TYPE_CHECKING:
    from demorec.sources.frames_writer import FramesImport


@dataclass(frozen=True, kw_only=True)
class SourceFormat:
    """Files or folders of other programs whose episodes have evenly spaced frames.

    Attributes:
        kind: What `demorec.runs.find` takes them for.
        name: In a sentence, of many.
        example: What follows `demorec import` and the format's word.
        read: (paths, mapping, out, how pixels are encoded, what its numbers are) -> what was made. The run `out` is
            made or continued. Heavy imports stand in it. Raises DemorecError.
        mapping: Whose keys its mappings have; None where it needs none.
        has_motor_units: Whether its numbers may be those of an arm's servos.
        suggest: Path -> the lines of a mapping, where it needs one.
    """

    kind: PathKind
    name: str
    example: str
    read: Callable[[Sequence[Path], Path | None, Path, VideoConfig, Motors | None], FramesImport]
    mapping: SourceKind | None = None
    has_motor_units: bool = False
    suggest: Callable[[Path], list[str]] = lambda path: []


def _read_lerobot(
    paths: Sequence[Path], mapping: Path | None, out: Path, video: VideoConfig, motors: Motors | None
) -> FramesImport:
    from demorec.sources.dataset_import import import_lerobot

    if len(paths) != 1:
        raise ConfigError(f"One dataset becomes one run, given are {len(paths)}: import them one by one.")
    return import_lerobot(paths[0], out, video=video, motors=motors)


def _read_hdf5(
    paths: Sequence[Path], mapping: Path | None, out: Path, video: VideoConfig, motors: Motors | None
) -> FramesImport:
    from demorec.sources.hdf5_import import import_hdf5

    assert mapping is not None, "whoever calls asks for it"
    return import_hdf5(paths, mapping, out, video=video)


def _suggest_hdf5(path: Path) -> list[str]:
    from demorec.sources.hdf5_suggest import suggested_hdf5_mapping

    return suggested_hdf5_mapping(path)


_ROWS = (
    SourceFormat(
        kind="dataset",
        name="LeRobot datasets",
        example="datasets/cups --out runs/cups",
        read=_read_lerobot,
        has_motor_units=True,
    ),
    SourceFormat(
        kind="hdf5",
        name="HDF5 files",
        example="demo.hdf5 --mapping mapping.toml --out runs/demo",
        read=_read_hdf5,
        mapping="hdf5",
        suggest=_suggest_hdf5,
    ),
)
FORMATS: Mapping[str, SourceFormat] = {IMPORT_WORDS[form.kind]: form for form in _ROWS}
"""The first word after `demorec import` -> the format."""
IMPORTED: tuple[PathKind, ...] = ("rosbag", *(kind for kind in IMPORT_WORDS if kind != "dataset"))
"""Kinds of paths that no command reads as they are. Datasets are, but where recordings are needed (export)."""

"""A format: one CSV file an episode, exported and imported."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec import Recorder
from demorec.api import (
    CommonOptions,
    Exporter,
    ExportReport,
    ProgressCallback,
    ReplaceableKind,
    atomic_write,
    find_recordings,
    open_recording,
)

HEAD = "time_s"
KIND = ReplaceableKind(name="a CSV file of our lab", recognises=lambda path: path.read_text().startswith(HEAD))
FPS = 30


@dataclass(frozen=True, kw_only=True)
class LabOptions(CommonOptions):
    """Options of an export to a CSV file."""

    digits: int = 9
    """Digits of each number."""


EXPORTER = Exporter(
    summary="the state of one episode, one row a frame", options=LabOptions, function="lab_extension.csv_files:export"
)


def export(sources: Sequence[Path], out: Path, options: LabOptions, progress: ProgressCallback | None) -> ExportReport:
    """Write the state of the first recording."""
    path = find_recordings(sources)[0]
    with atomic_write(out, KIND, overwrite=options.overwrite) as part, open_recording(path) as recording:
        state = recording.table().features["observation.state"]
        times = (recording.time_ns - recording.time_ns[0]) / 1e9
        numbers = np.column_stack([times, state])
        rows = [[f"{number:.{options.digits}g}" for number in row] for row in numbers.tolist()]
        with part.open("w", newline="") as file:
            csv.writer(file).writerows([[HEAD, *(f"q{index}" for index in range(state.shape[1]))], *rows])
    if progress is not None:
        progress(1, 1)
    return ExportReport(path=out, num_episodes=1, num_frames=len(rows), new_episodes=1)


@dataclass(frozen=True, kw_only=True)
class Imported:
    """Result of an import."""

    num_episodes: int
    num_frames: int
    num_new: int
    cameras: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)

    def left_out_lines(self) -> Iterator[str]:
        """Return no lines: an import keeps everything."""
        yield from ()


def import_files(paths: Sequence[Path], mapping: Path | None, out: Path, **options: Any) -> Imported:
    """Make a run with an episode for each file."""
    del mapping, options
    num_frames = 0
    with Recorder(out, robot="lab_arm", fps=FPS, when_full="wait") as recorder:
        for path in paths:
            rows = list(csv.reader(path.read_text().splitlines()))[1:]
            with recorder.episode("replay of a table") as episode:
                for row in rows:
                    time_s, *state = map(float, row)
                    episode.write(state, state, time_ns=round(time_s * 1e9) + 1)
            num_frames += len(rows)
    return Imported(num_episodes=len(paths), num_frames=num_frames, num_new=len(paths))

"""A kind of language, and a file of a dataset."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

from demorec.api import CommonOptions, ExportEpisode, Recording, Statement


def mottoes(recording: Recording, kinds: Collection[str]) -> list[Statement]:
    """Return a motto for the last frame."""
    assert kinds == ("motto",)
    return [Statement(row=recording.num_frames - 1, kind="motto", text="tidiness is everything")]


class FrameCounts:
    """Writer of frame_counts.json."""

    def __init__(self, root: Path, fps: int) -> None:
        self.path, self.content = root / "frame_counts.json", [fps]

    @staticmethod
    def read(episode: ExportEpisode[CommonOptions]) -> int:
        """Count the frames of an episode."""
        return episode.num_frames

    def add(self, num_frames: int) -> None:
        """Keep the number of an episode."""
        self.content.append(num_frames)

    def finish(self) -> None:
        """Write the file."""
        self.path.write_text(json.dumps(self.content))

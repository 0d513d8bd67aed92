"""A command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demorec.api import Positional, say


@dataclass(frozen=True, kw_only=True)
class CountFrames:
    """Count the frames of a recording.

    Examples:
      demorec count-frames recordings/cubes/episodes/episode_000000.mcap
    """

    path: Positional[Path]
    """The recording."""

    def run(self) -> int:
        """Count and print."""
        from demorec.api import open_recording

        with open_recording(self.path) as recording:
            say(f"{recording.num_frames} frames")
        return 0

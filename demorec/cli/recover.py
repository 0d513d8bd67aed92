"""`demorec recover`: what a crash left, as a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from demorec.cli.output import say
from demorec.runs.find import expect


@dataclass(frozen=True, kw_only=True)
class Recover:
    """Turn what a crash left of a recording into an indexed one.

    Everything whole is kept: all frames up to the last second before the crash. The damaged file stays as it is.
    Exits with 1 when there is nothing to keep.

    Examples:
      demorec recover recordings/cubes/unfinished/node-1-0/episode_000003.mcap.part
      demorec recover broken.mcap --out kept.mcap
    """

    file: Positional[Path]
    """An unfinished recording (NAME.mcap.part), or a finished one that was damaged."""
    out: Path | None = None
    """The recording to be made (auto: NAME.mcap beside NAME.mcap.part, NAME.recovered.mcap beside NAME.mcap)."""
    overwrite: bool = False
    """Replace the recording that is to be made, if it is there."""

    def run(self) -> int:
        """Recover and say how much was kept."""
        from demorec.recording import recover

        expect(self.file, "recording", "unfinished")
        result = recover(self.file, self.out or _default_target(self.file), overwrite=self.overwrite)
        if result.is_complete:
            say(f"Complete: all {result.num_frames} frames and the outcome are there: {result.path}")
        else:
            say(f"Kept {result.num_frames} frames, then {result.reason}: {result.path}")
        return 0


def _default_target(file: Path) -> Path:
    if file.suffix == ".part":
        return file.with_suffix("")
    return file.with_name(f"{file.stem}.recovered{file.suffix or '.mcap'}")

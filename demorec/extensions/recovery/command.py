"""`demorec recover`: recover a recording after a crash."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demorec.cli.shared.flags import Positional
from demorec.cli.shared.output import say
from demorec.core.replacing import OptionalTarget
from demorec.runs.find import EVALUATION_NAME, expect
from demorec.runs.run_file import EPISODES, FAILED, RUN_NAME


@dataclass(frozen=True, kw_only=True)
class Recover:
    """Recover a recording that a crash cut off or damaged.

    Keeps all intact data: all frames up to the last second before the crash. The damaged file stays as it is. An intact
    recording is not copied unless --out is given. Exit code 1 if there is nothing to keep.

    Examples:
      demorec recover recordings/cubes/unfinished/node-1-0/episode_000003.mcap.part
      demorec recover broken.mcap --out kept.mcap
    """

    file: Positional[Path]
    """Unfinished recording (NAME.mcap.part), or a damaged finished one."""
    out: OptionalTarget = None
    """Recording to write (auto: NAME.mcap next to NAME.mcap.part; NAME.recovered.mcap next to NAME.mcap, or in
    RUN/recovered for an episode of a run or an evaluation).
    """
    overwrite: bool = False
    """Replace an existing recording with that name."""

    def run(self) -> int:
        """Recover and print how much was kept."""
        from demorec.extensions.recovery.recover import is_whole, recover

        found = expect(self.file, "recording", "unfinished")
        if found.kind == "recording" and self.out is None and is_whole(self.file):
            say(f"Nothing to recover, the recording is whole: {self.file}")
            return 0
        result = recover(self.file, self.out or _default_target(self.file), overwrite=self.overwrite)
        if result.is_complete:
            say(f"Complete: all {result.num_frames} frames and the outcome are there: {result.path}")
        else:
            say(f"Kept {result.num_frames} frames, then {result.reason}: {result.path}")
        return 0


def _default_target(file: Path) -> Path:
    if file.suffix == ".part":
        return file.with_suffix("")
    name = f"{file.stem}.recovered{file.suffix or '.mcap'}"
    folder = file.absolute().parent
    marks = (RUN_NAME, EVALUATION_NAME)
    if folder.name in (EPISODES, FAILED) and any((folder.parent / mark).is_file() for mark in marks):
        return folder.parent / "recovered" / name  # in the same folder it would count as one more episode
    return file.with_name(name)

"""`demorec dataset repair` and `demorec dataset cut`: fix wrong tables, and split episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from demorec.cli.shared.output import say
from demorec.core.errors import ConfigError, check_option
from demorec.extensions.editing.commands.edit import EditOne, dataset_at, pairs

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.extensions.editing.plan import Plan


@dataclass(frozen=True, kw_only=True)
class Repair(EditOne):
    """Rebuild tables, counts, indices, types and statistics from the rows and videos, and list each change.

    Rows, images and texts are never invented: faults that would need it are refused, or their episodes are left out. A
    dataset without faults is not rewritten.

    Examples:
      demorec dataset repair cups --dry-run
      demorec dataset repair cups --out sound
    """

    def sources(self) -> Sequence[LeRobotFolder]:
        """The dataset, reconstructed from its rows."""
        from demorec.extensions.editing.repair import RepairedDataset

        return [RepairedDataset(dataset_at(self.dataset))]

    def has_work(self, sources: Sequence[LeRobotFolder]) -> bool:
        """Whether there is anything to repair."""
        if not sources[0].notes:
            say(f"Nothing to repair, so nothing is written: {self.dataset}")
        return bool(sources[0].notes)

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes with readable rows and images."""
        from demorec.extensions.editing.repair import RepairedDataset

        assert isinstance(sources[0], RepairedDataset)
        return sources[0].plan()


@dataclass(frozen=True, kw_only=True)
class Cut(EditOne):
    """Cut episodes into parts: before given frames, at jumps of the data, or around pauses, which are removed.

    Each part becomes an episode. Packets pass through; images that a part needs from before its first frame stay in the
    video and are counted.

    Examples:
      demorec dataset cut cups --at 0=120,260 3=45 --out parts
      demorec dataset cut cups --jumps --out rollouts
      demorec dataset cut cups --pauses 1.5 --out moving
    """

    at: tuple[str, ...] = ()
    """Episodes and the first frames of further parts, 0=120,260 3=45."""
    jumps: bool = False
    """Cut where the state jumps, e.g. if several rollouts were recorded as one episode."""
    pauses: float | None = None
    """Remove each pause of at least this many seconds."""
    feature: tuple[str, ...] = ()
    """With --jumps or --pauses: features to watch (auto: the state without grippers)."""
    jump_threshold: float = 0.05
    """With --jumps: minimum excess of a jump over neighbouring steps, as a ratio of the range."""
    still_threshold: float = 0.01
    """With --pauses: minimum change that counts as motion, as a ratio of the range."""
    margin: int = 3
    """With --pauses: still frames to keep at either end of a pause."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, cut."""
        from demorec.extensions.editing import cut

        (source,) = sources
        if [bool(self.at), self.jumps, self.pauses is not None].count(True) != 1:
            raise ConfigError("Name the cuts: --at EPISODE=FRAMES, --jumps or --pauses SECONDS.")
        if self.at:
            return cut.cut_at(source, self._frames())
        if self.pauses is None:
            return cut.cut_at_jumps(source, self.feature, self.jump_threshold)
        check_option("margin", self.margin, 0, 2**31 - 1, "frames")
        check_option("pauses", self.pauses, 0, 86400, "seconds")
        return cut.without_pauses(
            source,
            self.feature,
            min_frames=round(self.pauses * source.info.fps),
            threshold=self.still_threshold,
            margin=self.margin,
        )

    def _frames(self) -> dict[int, list[int]]:
        example = "--at 0=120,260 3=45"
        try:
            return {
                int(name): [int(frame) for frame in frames.split(",")]
                for name, frames in pairs(self.at, example).items()
            }
        except ValueError as error:
            raise ConfigError(f"An episode and its frames are numbers: {example}.") from error

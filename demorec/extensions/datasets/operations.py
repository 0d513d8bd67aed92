"""Commands that cut episodes, change features, merge, repair and compare datasets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import ProgressBar, counted, say
from demorec.core.errors import ConfigError, ExportError, check_option
from demorec.core.plain import listed
from demorec.extensions.datasets.command import Edit, EditOne, dataset_at, leave_pandas_out, pairs

if TYPE_CHECKING:
    from demorec.extensions.datasets.folder import LeRobotFolder
    from demorec.extensions.datasets.plan import Plan

_MAX_LISTED = 30


@dataclass(frozen=True, kw_only=True)
class Trim(EditOne):
    """Cut frames off the beginning and the end of each episode.

    Examples:
      demorec dataset trim cups --idle --out moving
      demorec dataset trim cups --head 10 --tail 5 --out shorter
    """

    head: int = 0
    """Frames to cut off at the beginning of each episode."""
    tail: int = 0
    """Frames to cut off at the end."""
    idle: bool = False
    """Cut off the frames before the first and after the last motion."""
    idle_threshold: float = 0.01
    """With --idle: minimum change of the state that counts as motion, as a ratio of its range."""
    idle_margin: int = 3
    """With --idle: still frames to keep at either end."""

    def edited(self, plan: Plan) -> Plan:
        """All episodes, trimmed."""
        from demorec.extensions.datasets.cut import without_idle_ends

        if self.idle == bool(self.head or self.tail):
            raise ConfigError("Give either --idle, or frames by --head and --tail.")
        if self.idle:
            check_option("idle_margin", self.idle_margin, 0, 2**63 - 1, "frames")
            return without_idle_ends(plan, self.idle_threshold, self.idle_margin)
        if min(self.head, self.tail) < 0:
            raise ConfigError("The number of frames to cut off must be at least 0.")
        if short := [str(cut.episode) for cut in plan.cuts if cut.last <= self.head + self.tail]:
            raise ConfigError(f"These episodes would be empty, drop them first: {listed(short, _MAX_LISTED, ',')}")
        return plan.with_cuts([replace(cut, first=self.head, last=cut.last - self.tail) for cut in plan.cuts])


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

    def edited(self, plan: Plan) -> Plan:
        """All episodes, cut."""
        from demorec.extensions.datasets import cut

        if [bool(self.at), self.jumps, self.pauses is not None].count(True) != 1:
            raise ConfigError("Name the cuts: --at EPISODE=FRAMES, --jumps or --pauses SECONDS.")
        if self.at:
            return cut.cut_at(plan, self._frames())
        if self.pauses is None:
            return cut.cut_at_jumps(plan, self.feature, self.jump_threshold)
        check_option("margin", self.margin, 0, 2**31 - 1, "frames")
        check_option("pauses", self.pauses, 0, 86400, "seconds")
        return cut.without_pauses(plan, self.feature, self.pauses, self.still_threshold, self.margin)

    def _frames(self) -> dict[int, list[int]]:
        example = "--at 0=120,260 3=45"
        try:
            found = pairs(self.at, example)
            return {int(name): [int(frame) for frame in frames.split(",")] for name, frames in found.items()}
        except ValueError as error:
            raise ConfigError(f"An episode and its frames are numbers: {example}.") from error


@dataclass(frozen=True, kw_only=True)
class Rename(EditOne):
    """Rename features.

    Examples:
      demorec dataset rename cups observation.image=observation.images.top --out new
      demorec dataset rename cups state=observation.state actions=action --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="OLD=NEW", help="Old and new name of each feature.")]

    def edited(self, plan: Plan) -> Plan:
        """All episodes with renamed features."""
        return plan.renamed(pairs(self.names, "rename DATASET OLD=NEW"))


@dataclass(frozen=True, kw_only=True)
class DropFeatures(EditOne):
    """Leave out features.

    Examples:
      demorec dataset drop-features cups observation.images.side --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME", help="Features to leave out.")]

    def edited(self, plan: Plan) -> Plan:
        """All episodes without these features."""
        if not self.names:
            raise ConfigError(
                "Name the features to leave out: demorec dataset drop-features DATASET NAME... --out NEW."
            )
        return plan.without_features(self.names)


@dataclass(frozen=True, kw_only=True)
class Merge(Edit):
    """Merge datasets; features are matched by name, and all differences are reported at once.

    Examples:
      demorec dataset merge monday tuesday --out both
      demorec dataset merge monday tuesday --mapping mapping.toml --out both
    """

    datasets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DATASET", help="Datasets, or runs that have one; two or more.")
    ]
    mapping: Path | None = None
    """Mapping file (TOML) for datasets that differ."""

    def sources(self) -> Sequence[LeRobotFolder]:
        """The datasets in the given order."""
        from demorec.extensions.datasets.folder import LeRobotFolder

        return [LeRobotFolder(dataset_at(path)) for path in self.datasets]

    def plans(self, sources: Sequence[LeRobotFolder]) -> Mapping[str, Plan]:
        """All episodes, dataset after dataset."""
        from demorec.extensions.datasets.merge import differences, joined, mapped_plans

        plans = mapped_plans(sources, self.mapping)
        if wrong := differences(plans):
            raise ConfigError(
                f"These datasets differ: {'; '.join(wrong)}. Resolve it by a --mapping (docs/datasets.md)."
            )
        return {"": joined(plans)}


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
        from demorec.extensions.datasets.repair import RepairedDataset

        return [RepairedDataset(dataset_at(self.dataset))]

    def has_work(self, sources: Sequence[LeRobotFolder]) -> bool:
        """Whether there is anything to repair."""
        if not sources[0].notes:
            say(f"Nothing to repair, so nothing is written: {self.dataset}")
        return bool(sources[0].notes)

    def edited(self, plan: Plan) -> Plan:
        """All episodes with readable rows and images, with the instructions that their rows lack, and the splits."""
        from demorec.extensions.datasets.repair import RepairedDataset

        (source,) = plan.sources
        assert isinstance(source, RepairedDataset)
        if source.splits:
            plan = replace(plan, info=replace(plan.info, other={**plan.info.other, "splits": source.splits}))
        return plan.with_cuts([replace(cut, task=source.instructions.get(cut.episode, "")) for cut in plan.cuts])


@dataclass(frozen=True, kw_only=True)
class Diff:
    """Compare features, rows and encoded images of two datasets, in any order of their episodes.

    Exit code 0: no difference, 1: some, 2: unreadable.

    Examples:
      demorec dataset diff cups sorted
    """

    a: Annotated[Positional[Path], arg(metavar="A", help="A dataset, or a run that has one.")]
    b: Annotated[Positional[Path], arg(metavar="B", help="Another dataset, or a run that has one.")]

    def run(self) -> int:
        """Compare and print the differences."""
        from demorec.extensions.datasets.diff import diff

        leave_pandas_out()
        a, b = dataset_at(self.a), dataset_at(self.b)
        try:
            with ProgressBar("reading") as bar:
                found = diff(a, b, progress=bar.set)
        except ExportError as error:  # its exit code would mean that the datasets differ
            raise ConfigError(str(error)) from error
        count = len(found.differences)
        say(*found.lines(), *found.notes)
        episodes = f"{found.num_same} of {found.num_episodes[0]} and {found.num_episodes[1]} episodes are the same"
        say(f"{counted(count, 'difference') if count else 'No difference'}: {episodes}.")
        return int(count > 0)

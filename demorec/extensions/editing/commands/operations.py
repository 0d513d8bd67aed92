"""Commands that make a new dataset: selection, order, names, features and texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import say
from demorec.core.errors import ConfigError
from demorec.extensions.editing.commands.edit import CONDITION_HELP, Edit, EditOne, dataset_at, pairs

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.extensions.editing.plan import Plan


@dataclass(frozen=True, kw_only=True)
class Chosen(EditOne):
    """Flags that select episodes."""

    where: Annotated[str, arg(help=CONDITION_HELP)] = ""
    episodes: tuple[str, ...] = ()
    """Numbers of episodes, 0,3,5:9."""

    def chosen(self, source: LeRobotFolder) -> list[int]:
        """Numbers of the selected episodes."""
        from demorec.datasets.options import select_episodes
        from demorec.extensions.editing.operations import chosen, columns_of, names_in

        rows = columns_of(source, names_in(self.where))
        return chosen(rows, self.where, select_episodes(range(len(rows)), " ".join(self.episodes)))


@dataclass(frozen=True, kw_only=True)
class Select(Chosen):
    """Keep episodes by number or condition.

    Examples:
      demorec dataset select cups --where 'success and num_frames < 300' --out good
      demorec dataset select cups --where 'verdict == "good"' --out good
      demorec dataset select cups --episodes 0:50 --out first
    """

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """The selected episodes."""
        return self._select(sources[0], drop=False)

    def _select(self, source: LeRobotFolder, *, drop: bool) -> Plan:
        from demorec.extensions.editing.operations import select

        if not self.where and not self.episodes:
            raise ConfigError(f"Choose the episodes to {'drop' if drop else 'keep'}: --where or --episodes.")
        return select(source, self.chosen(source), drop=drop)


@dataclass(frozen=True, kw_only=True)
class Drop(Select):
    """Leave out episodes by number or condition.

    Examples:
      demorec dataset drop cups --episodes 3,7,20:25 --out rest
      demorec dataset drop cups --where 'not success' --out successes
    """

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes except the selected ones."""
        return self._select(sources[0], drop=True)


@dataclass(frozen=True, kw_only=True)
class SetTask(Chosen):
    """Give all episodes, or the selected ones, another instruction.

    Examples:
      demorec dataset set-task cups --task 'pick up the cup' --out relabelled
      demorec dataset set-task cups --task 'lift it' --episodes 0:9 --out relabelled
    """

    task: str = ""
    """The new instruction."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, with the new instruction for the selected ones."""
        from demorec.extensions.editing.operations import set_task

        return set_task(sources[0], self.task, self.chosen(sources[0]))


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
    idle_feature: str | None = None
    """With --idle: feature whose changes count as motion (auto: the state)."""
    idle_threshold: float = 0.01
    """With --idle: minimum change that counts as motion, as a ratio of the feature's range."""
    idle_margin: int = 3
    """With --idle: still frames to keep at either end."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, trimmed."""
        from demorec.extensions.editing import operations

        if self.idle == bool(self.head or self.tail):
            raise ConfigError("Give either --idle, or frames by --head and --tail.")
        if self.idle:
            features = self._state(sources[0]) if self.idle_feature is None else (self.idle_feature,)
            return operations.trim_idle(sources[0], features, self.idle_threshold, self.idle_margin)
        return operations.trim(sources[0], self.head, self.tail)

    def _state(self, source: LeRobotFolder) -> tuple[str, ...]:
        """Features of the state; ConfigError if none is found."""
        found = source.roles.state
        if not found:
            raise ConfigError(f"No state was found: name a feature by --idle-feature: {source.root}")
        return found


@dataclass(frozen=True, kw_only=True)
class Split(EditOne):
    """Split a dataset into parts, each in a folder with its name in --out; all appear together.

    Examples:
      demorec dataset split cups --shares train=0.8 val=0.2 --out parts
      demorec dataset split cups --shares train=0.8 val=0.2 --by task --out parts
    """

    shares: tuple[str, ...] = ()
    """Names and shares of the parts, train=0.8 val=0.2."""
    by: str = ""
    """Column to stratify by: each of its values is divided in the same proportions."""
    seed: int = 0
    """Seed of the random parts."""

    def part_names(self) -> Sequence[str]:
        """Names of the parts."""
        return list(self._shares())

    def plans(self, sources: Sequence[LeRobotFolder]) -> Mapping[str, Plan]:
        """Name of each part -> its plan."""
        from demorec.extensions.editing.operations import columns_of, split

        rows = columns_of(sources[0], {self.by})
        return split(sources[0], rows, self._shares(), self.seed, by=self.by)

    def _shares(self) -> Mapping[str, float]:
        example = "--shares train=0.8 val=0.2"
        try:
            found = pairs(" ".join(self.shares).replace(",", " ").split(), example)
            shares = {name: float(share) for name, share in found.items()}
        except ValueError as error:
            raise ConfigError(f"A share is a number: {example}.") from error
        if wrong := [name for name in shares if Path(name).name != name or name in ("", ".", "..")]:
            raise ConfigError(f"A part cannot be called {wrong[0]!r}: its name is also its folder.")
        return shares


@dataclass(frozen=True, kw_only=True)
class Merge(Edit):
    """Merge datasets; features are matched by name, and all differences are reported at once.

    If datasets differ, prints a mapping that merges as much as possible: check its lines, save them, and use --mapping.

    Examples:
      demorec dataset merge monday tuesday --out both
      demorec dataset merge monday tuesday --out both > mapping.toml
      demorec dataset merge monday tuesday --mapping mapping.toml --out both
    """

    datasets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DATASET", help="Datasets, or runs that have one; two or more.")
    ]
    mapping: Path | None = None
    """Mapping file (TOML) for datasets that differ."""

    def sources(self) -> Sequence[LeRobotFolder]:
        """The datasets in the given order."""
        from demorec.datasets.lerobot.folder import LeRobotFolder

        return [LeRobotFolder(dataset_at(path)) for path in self.datasets]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes, dataset after dataset."""
        from demorec.extensions.editing.merge import DatasetsDifferError, merge

        try:
            return merge(sources, self.mapping)
        except DatasetsDifferError as error:
            if not error.mapping:
                raise
            say(*error.mapping)
            raise ConfigError(
                f"{error} The lines above are a possible mapping: check each, save them (> FILE), use --mapping FILE."
            ) from error


@dataclass(frozen=True, kw_only=True)
class Rename(EditOne):
    """Rename features.

    Examples:
      demorec dataset rename cups observation.image=observation.images.top --out new
      demorec dataset rename cups state=observation.state actions=action --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="OLD=NEW", help="Old and new name of each feature.")]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes with renamed features."""
        from demorec.extensions.editing.operations import rename

        return rename(sources[0], pairs(self.names, "rename DATASET OLD=NEW"))


@dataclass(frozen=True, kw_only=True)
class DropFeatures(EditOne):
    """Leave out features.

    Examples:
      demorec dataset drop-features cups observation.images.side --out new
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME", help="Features to leave out.")]

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes without these features."""
        from demorec.extensions.editing.operations import drop_features

        return drop_features(sources[0], self.names)


@dataclass(frozen=True, kw_only=True)
class Reorder(EditOne):
    """Put the episodes into another order: sorted by a column, or as listed.

    Examples:
      demorec dataset reorder cups --by num_frames --out sorted
      demorec dataset reorder cups --order 2,0,1 --out new
    """

    by: str = ""
    """Column to sort by."""
    descending: bool = False
    """With --by: largest first."""
    order: tuple[str, ...] = ()
    """Numbers of all episodes in their new order, 2,0,1."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes in the new order."""
        from demorec.datasets.options import select_episodes
        from demorec.extensions.editing.operations import columns_of, reorder

        rows = columns_of(sources[0], {self.by}) if self.by else ()
        numbers = range(len(sources[0].places))
        order = select_episodes(numbers, " ".join(self.order), "order") if self.order else ()
        return reorder(sources[0], rows, self.by, order, descending=self.descending)


@dataclass(frozen=True, kw_only=True)
class Shuffle(EditOne):
    """Put the episodes into a random order.

    Examples:
      demorec dataset shuffle cups --seed 7 --out shuffled
    """

    seed: int = 0
    """Seed of the order."""

    def plan(self, sources: Sequence[LeRobotFolder]) -> Plan:
        """All episodes in a random order by seed."""
        from demorec.extensions.editing.operations import shuffle

        return shuffle(sources[0], self.seed)

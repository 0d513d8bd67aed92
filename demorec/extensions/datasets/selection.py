"""Commands that select, order, split and relabel episodes.

Each edits a `Plan`; what is heavy is imported when the command runs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from demorec.cli.shared.flags import arg
from demorec.core.errors import ConfigError, check_seed
from demorec.datasets.options import select_episodes
from demorec.extensions.datasets.command import EditOne, pairs

if TYPE_CHECKING:
    from demorec.extensions.datasets.folder import LeRobotFolder
    from demorec.extensions.datasets.plan import Plan

_SHARE_TOLERANCE = 1e-6
_CONDITION_HELP = (
    "Condition on columns of the table of episodes or of demorec's sidecar, and on episode_index, num_frames, "
    'duration_s, task, and verdict, score of demorec check: success and num_frames < 300; "cube" in task.'
)


@dataclass(frozen=True, kw_only=True)
class Chosen(EditOne):
    """Flags that select episodes."""

    where: Annotated[str, arg(help=_CONDITION_HELP)] = ""
    episodes: tuple[str, ...] = ()
    """Numbers of episodes, 0,3,5:9."""

    def chosen(self, plan: Plan) -> set[int]:
        """Numbers of the selected episodes."""
        from demorec.extensions.datasets.condition import matching_episodes

        numbers = select_episodes(range(len(plan.cuts)), " ".join(self.episodes))
        return matching_episodes(plan.sources[0], self.where).intersection(numbers)


@dataclass(frozen=True, kw_only=True)
class Select(Chosen):
    """Keep episodes by number or condition.

    Examples:
      demorec dataset select cups --where 'success and num_frames < 300' --out good
      demorec dataset select cups --where 'verdict == "good"' --out good
      demorec dataset select cups --episodes 0:50 --out first
    """

    def edited(self, plan: Plan) -> Plan:
        """The selected episodes."""
        if not self.where and not self.episodes:
            raise ConfigError("Choose the episodes: --where or --episodes.")
        return plan.with_episodes(self.kept(plan))

    def kept(self, plan: Plan) -> Sequence[int]:
        """Numbers of the episodes to keep."""
        return sorted(self.chosen(plan))


@dataclass(frozen=True, kw_only=True)
class Drop(Select):
    """Leave out episodes by number or condition.

    Examples:
      demorec dataset drop cups --episodes 3,7,20:25 --out rest
      demorec dataset drop cups --where 'not success' --out successes
    """

    def kept(self, plan: Plan) -> Sequence[int]:
        """Numbers of all episodes except the selected ones."""
        return sorted(set(range(len(plan.cuts))) - self.chosen(plan))


@dataclass(frozen=True, kw_only=True)
class SetTask(Chosen):
    """Give all episodes, or the selected ones, another instruction.

    Examples:
      demorec dataset set-task cups --task 'pick up the cup' --out relabelled
      demorec dataset set-task cups --task 'lift it' --episodes 0:9 --out relabelled
    """

    task: str = ""
    """The new instruction."""

    def edited(self, plan: Plan) -> Plan:
        """All episodes, with the new instruction for the selected ones."""
        chosen = self.chosen(plan)
        if not self.task.strip() or not self.task.isprintable():
            raise ConfigError("An instruction is a line of text, such as --task 'pick up the cup'.")
        if not chosen:
            raise ConfigError("No episode is selected for the new instruction.")
        return plan.with_cuts([replace(cut, task=self.task) if cut.episode in chosen else cut for cut in plan.cuts])


@dataclass(frozen=True, kw_only=True)
class Reorder(EditOne):
    """Put the episodes into another order.

    Examples:
      demorec dataset reorder cups --order 2,0,1 --out new
    """

    order: tuple[str, ...] = ()
    """Numbers of all episodes in their new order, 2,0,1."""

    def edited(self, plan: Plan) -> Plan:
        """All episodes in the new order."""
        count = len(plan.cuts)
        order = select_episodes(range(count), " ".join(self.order), "order")
        if not self.order or sorted(order) != list(range(count)):
            raise ConfigError(f"--order names each of the {count} episodes once, from 0 on.")
        return plan.with_episodes(order)


@dataclass(frozen=True, kw_only=True)
class Shuffle(EditOne):
    """Put the episodes into a random order.

    Examples:
      demorec dataset shuffle cups --seed 7 --out shuffled
    """

    seed: int = 0
    """Seed of the order."""

    def edited(self, plan: Plan) -> Plan:
        """All episodes in a random order by seed."""
        import numpy as np

        check_seed("seed", self.seed)
        return plan.with_episodes(np.random.default_rng(self.seed).permutation(len(plan.cuts)).tolist())


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
        """Name of each part -> its plan, in the dataset's order; no part is empty."""
        import numpy as np

        from demorec.extensions.datasets.plan import Plan

        shares, plan = self._shares(), Plan.whole(sources[0])
        found: dict[str, list[int]] = {name: [] for name in shares}
        ends = np.cumsum(list(shares.values()))
        rng = np.random.default_rng(self.seed)
        for group in self._groups(plan):
            order = rng.permutation(group)
            begins = [0, *np.rint(ends * len(order)).astype(int).tolist()]
            for name, begin, end in zip(shares, begins, begins[1:], strict=False):
                found[name] += order[begin:end].tolist()
        if empty := [name for name, numbers in found.items() if not numbers]:
            raise ConfigError(f"The part {empty[0]} would be empty: the dataset has {len(plan.cuts)}.")
        return {name: plan.with_episodes(sorted(numbers)) for name, numbers in found.items()}

    def _groups(self, plan: Plan) -> Collection[Sequence[int]]:
        """Numbers of the episodes with each value of the column."""
        from demorec.extensions.datasets.condition import check_column, columns_of

        if not self.by:
            return [range(len(plan.cuts))]
        rows = columns_of(plan.sources[0], {self.by})
        check_column(self.by, rows)
        groups: dict[str, list[int]] = {}
        for number, row in enumerate(rows):
            groups.setdefault(str(row.get(self.by)), []).append(number)
        return groups.values()

    def _shares(self) -> Mapping[str, float]:
        check_seed("seed", self.seed)
        example = "--shares train=0.8 val=0.2"
        try:
            found = pairs(" ".join(self.shares).replace(",", " ").split(), example)
            shares = {name: float(share) for name, share in found.items()}
        except ValueError as error:
            raise ConfigError(f"A share is a number: {example}.") from error
        if wrong := [name for name in shares if Path(name).name != name or name in ("", ".", "..")]:
            raise ConfigError(f"A part cannot be called {wrong[0]!r}: its name is also its folder.")
        total = sum(shares.values())
        is_whole = abs(total - 1) <= _SHARE_TOLERANCE
        if len(shares) < 2 or not all(share > 0 for share in shares.values()) or not is_whole:
            raise ConfigError(
                f"Shares are two or more numbers above 0 whose sum is 1, not {total:g}, such as {example}."
            )
        return shares

"""Changes of a recording in memory: good numbers with one thing wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.episode.episode import Columns, Outcome
from demorec.episode.info import EpisodeInfo

Rows = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Changed:
    """What is put in a recording's place; None leaves it."""

    columns: Columns
    info: EpisodeInfo
    outcome: Outcome

    def with_columns(self, **arrays: Any) -> Changed:
        """With other columns, which must differ."""
        for name, array in arrays.items():
            before = getattr(self.columns, name)
            pairs = [(before[key], array[key]) for key in array] if isinstance(array, dict) else [(before, array)]
            assert not all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs), f"{name} was not changed"
        return replace(self, columns=replace(self.columns, **arrays))

    def with_info(self, **fields: Any) -> Changed:
        """With another description, which must differ."""
        of_episode = {known.name for known in dataclasses.fields(EpisodeInfo)} & fields.keys()
        info = replace(self.info, **{name: fields.pop(name) for name in of_episode}).with_simulation(**fields)
        assert info != self.info
        return replace(self, info=info)

    def with_outcome(self, **fields: Any) -> Changed:
        """With another outcome, which must differ."""
        outcome = replace(self.outcome, **fields)
        assert outcome != self.outcome
        return replace(self, outcome=outcome)


Fault = Callable[[Changed], Changed]


def info(**fields: Any) -> Fault:
    """Another description."""
    return lambda c: c.with_info(**fields)


def outcome(**fields: Any) -> Fault:
    """Another outcome."""
    return lambda c: c.with_outcome(**fields)


def condition(name: str, **fields: Any) -> Fault:
    """Another result of a condition of success."""

    def fault(c: Changed) -> Changed:
        assert any(check.name == name for check in c.outcome.checks)
        return c.with_outcome(
            checks=tuple(replace(check, **fields) if check.name == name else check for check in c.outcome.checks)
        )

    return fault


def both_grippers(change: Callable[[Rows], Rows]) -> Fault:
    """Other actions and commands of the gripper."""
    return lambda c: c.with_columns(
        action_gripper=change(c.columns.action_gripper), command_gripper=change(c.columns.command_gripper)
    )


def late(rows: Rows) -> Rows:
    """One frame late, the first one twice."""
    return np.concatenate([rows[:1], rows[:-1]])

"""The attempts that stand beside a dataset, by the episode to which each belongs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from demorec.datasets.editing.plan import Plan, Source
from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA

Row = dict[str, Any]


class Attempts:
    """Those of one dataset.

    Attributes:
        homeless: Failed ones at episodes that the dataset has not.
    """

    def __init__(self, source: Source) -> None:
        rows = [
            row
            for path in sorted((source.root / SIDECAR_DIR / "attempts").glob("*/*.parquet"))
            for row in read_table(path, ATTEMPT_SCHEMA.names).to_pylist()
        ]
        inside = [number for number, row in enumerate(rows) if row["in_dataset"]]
        episodes = sorted(source.beside)
        # One row was written for every episode, in order.
        owners = dict(zip(inside, episodes, strict=True)) if len(inside) == len(episodes) else {}
        self._own = {episode: _less_place(rows[number]) for number, episode in owners.items()}
        self._failed: dict[int, list[Row]] = {}
        self.homeless: list[Row] = []
        for number, row in enumerate(rows):
            if row["in_dataset"]:
                continue
            # Several runs may have an episode of that number: the rows of one run stand together.
            same = [n for n in owners if rows[n]["run_episode_index"] == row["run_episode_index"]]
            if same:
                nearest = min(same, key=lambda n: abs(n - number))
                self._failed.setdefault(owners[nearest], []).append(_less_place(row))
            else:
                self.homeless.append(_less_place(row))

    def of(self, episode_index: int) -> Row | None:
        """The one that became an episode of the dataset."""
        return self._own.get(episode_index)

    def failed(self, episode_index: int) -> list[Row]:
        """Those before it that failed."""
        return self._failed.get(episode_index, [])


def _less_place(row: Row) -> Row:
    return {name: value for name, value in row.items() if name != "in_dataset"}


def kept_homeless(plan: Plan, number: int, attempts: Attempts) -> list[Row]:
    """Failed attempts at no episode of a source, which go along where all of its episodes do."""
    source = plan.sources[number]
    is_whole = {cut.episode for cut in plan.cuts if cut.source == number} == set(range(len(source.dataset.places)))
    return attempts.homeless if is_whole else []


def lost_attempts(plan: Plan, number: int) -> int:
    """How many failed attempts of a source do not go along."""
    attempts = Attempts(plan.sources[number])
    return sum(1 for _ in _lost(plan, number, attempts))


def _lost(plan: Plan, number: int, attempts: Attempts) -> Iterator[Row]:
    places = plan.sources[number].dataset.places
    kept = {cut.episode for cut in plan.cuts if cut.source == number}
    for episode, place in enumerate(places):
        if episode not in kept:
            yield from attempts.failed(place.episode_index)
    if not kept_homeless(plan, number, attempts):
        yield from attempts.homeless

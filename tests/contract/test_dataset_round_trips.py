"""An edit of a dataset and its inverse: `diff` finds no difference."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.export import export, make_run

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.extensions.editing.diff import diff
from demorec.extensions.editing.merge import merge
from demorec.extensions.editing.operations import rename, reorder, shuffle, split, trim
from demorec.extensions.editing.plan import Plan
from demorec.extensions.editing.write import write_plan

pytestmark = pytest.mark.slow

LENGTHS = (9, 7, 8, 6, 10)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demorec dataset with sidecar, boxes, progress, failed attempts and language."""
    folder = tmp_path_factory.mktemp("made")
    run = make_run(folder / "run", LENGTHS, failures=(1, 3), segmentation=True)
    export(run, folder / "d", boxes=True, progress=True, language=("subtask",))
    return folder / "d"


def written(plan: Plan, out: Path) -> LeRobotFolder:
    write_plan(plan, out)
    return LeRobotFolder(out)


def found(a: Path, b: Path) -> list[str]:
    return list(diff(a, b).lines())


def round_trips(dataset: Path, at: Path, order: list[int], seed: int, share: float) -> None:
    source = LeRobotFolder(dataset)
    assert found(dataset, written(trim(source, 0, 0), at / "trimmed").root) == []
    moved = written(reorder(source, order=order), at / "moved")
    back = written(reorder(moved, order=[order.index(number) for number in range(len(order))]), at / "back")
    assert found(dataset, back.root) == []
    assert diff(dataset, moved.root).pairs == {number: order.index(number) for number in range(len(order))}
    named = written(rename(moved, {"action": "a", "observation.images.wrist": "w"}), at / "named")
    names = {"action", "a", "observation.images.wrist", "w"}
    assert {line.split()[2] for line in found(dataset, named.root)} == names
    again = written(rename(named, {"a": "action", "w": "observation.images.wrist"}), at / "again")
    assert found(dataset, again.root) == []
    try:
        plans = split(source, [{} for _ in source.places], {"a": share, "b": 1 - share}, seed)
    except ConfigError:  # one part would be empty
        return
    parts = [written(plan, at / name) for name, plan in plans.items()]
    merged = written(merge(parts), at / "merged")
    assert found(dataset, merged.root) == []
    assert found(dataset, written(shuffle(merged, seed), at / "shuffled").root) == []


def test_one_round_trip(dataset: Path, tmp_path: Path) -> None:
    round_trips(dataset, tmp_path, [3, 0, 4, 2, 1], seed=1, share=0.4)

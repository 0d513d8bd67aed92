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
    """A demorec dataset with sidecar, boxes, progress, failed attempts and language, as an edit wrote it.

    An edit averages image quantiles over the episodes, where an export counts every pixel.
    """
    folder = tmp_path_factory.mktemp("made")
    run = make_run(folder / "run", LENGTHS, failures=(1, 3), segmentation=True)
    export(run, folder / "d", boxes=True, progress=True, language=("subtask",))
    copy = written(trim(LeRobotFolder(folder / "d"), 0, 0), folder / "copy").root
    assert {item.level for item in diff(folder / "d", copy).differences} == {"statistics"}
    assert all("images" in item.name for item in diff(folder / "d", copy).differences)
    return copy


def written(plan: Plan, out: Path) -> LeRobotFolder:
    write_plan(plan, out)
    return LeRobotFolder(out)


def found(a: Path, b: Path) -> list[str]:
    return [item.line for item in diff(a, b).differences]


def round_trips(dataset: Path, at: Path, order: list[int], seed: int, share: float) -> None:
    source = LeRobotFolder(dataset)
    assert found(dataset, written(trim(source, 0, 0), at / "trimmed").root) == []
    moved = written(reorder(source, order=order), at / "moved")
    back = written(reorder(moved, order=[order.index(number) for number in range(len(order))]), at / "back")
    assert found(dataset, back.root) == []
    assert not diff(dataset, back.root).is_reordered
    assert diff(dataset, moved.root).is_reordered == (order != sorted(order))
    named = written(rename(moved, {"action": "a", "observation.images.wrist": "w"}), at / "named")
    names = {"action", "a", "observation.images.wrist", "w"}
    assert {(item.level, item.name) for item in diff(dataset, named.root).differences} >= {
        ("features", n) for n in names
    }
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

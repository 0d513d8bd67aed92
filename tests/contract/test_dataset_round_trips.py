"""An edit of a dataset and its inverse: `diff` finds no difference, sidecar files included."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
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
BOXES = "demorec/boxes/observation.images.front.json"


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
    lines = [(item.level, item.name, item.details.get("b")) for item in diff(dataset, named.root).differences]
    assert sorted(lines) == [("features", "action", "a"), ("features", "observation.images.wrist", "w")]
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


def test_differences_of_boxes_are_named(dataset: Path, tmp_path: Path) -> None:
    other = written(reorder(LeRobotFolder(dataset), order=[1, 0, 2, 3, 4]), tmp_path / "d").root
    told: dict[str, Any] = json.loads((other / BOXES).read_text())
    # Episode 1 of the other dataset is its episode 0; frame 4 follows the 7 frames of the first.
    index = LENGTHS[1] + 4
    shown = next(item for item in told["annotations"] if item["image_id"] == index)
    lines = (other / BOXES).read_text().splitlines(keepends=True)
    number = next(n for n, line in enumerate(lines) if line.startswith(f'{{"id": {shown["id"]}, "image_id"'))
    before = json.dumps(shown["bbox"])
    assert before in lines[number]
    lines[number] = lines[number].replace(before, json.dumps([*np.array(shown["bbox"][:3]).tolist(), 1]))
    (other / BOXES).write_text("".join(lines))
    (one,) = diff(dataset, other).differences
    assert (one.level, one.name, one.episodes, one.details["frames"]) == (
        "rows", "boxes of observation.images.front", (0, 1), [4],
    )  # fmt: skip
    (other / BOXES).unlink()
    assert found(dataset, other) == ["features: boxes of observation.images.front are not in B"]

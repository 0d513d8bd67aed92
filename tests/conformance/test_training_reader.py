"""The plug-in's training reader on demorec's datasets: its items equal those of LeRobot's own reader, bit for bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_datasets import assert_same_item
from support.docs import run_examples
from support.export import export, export_in_files, make_run

LENGTHS = (7, 11, 5, 9)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("hf_datasets_cache")]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of several files with depth."""
    folder = tmp_path_factory.mktemp("datasets")
    run = make_run(folder / "run", LENGTHS, depth=True)
    export_in_files(run, folder / "d", privileged=True, depth=True, video_mb=0.002, data_mb=0.004)
    assert len(list((folder / "d" / "data").rglob("file-*"))) > 1
    return folder / "d"


def pair(root: Path, **arguments: Any) -> tuple[Any, Any]:
    """Open both readers with the same arguments."""
    from lerobot.datasets import LeRobotDataset

    from lerobot_policy_act_keypoints import FastDataset

    arguments = {"root": root, "video_backend": "pyav", "return_uint8": True, **arguments}
    return FastDataset("local/test", **arguments), LeRobotDataset("local/test", **arguments)


def assert_same(fast: Any, slow: Any) -> None:
    """Compare all items, in batches of a shuffled order."""
    assert len(fast) == len(slow) > 0
    order = np.random.default_rng(0).permutation(len(slow)).tolist()
    for start in range(0, len(order), 16):
        rows = order[start : start + 16]
        for row, item in zip(rows, fast.__getitems__(rows), strict=True):
            assert_same_item(item, slow[row])


def test_language_is_equal(tmp_path: Path) -> None:
    root = tmp_path / "spoken"
    export(make_run(tmp_path / "run", (5, 6)), root, language=())
    path = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    rows = table.column("language_events").to_pylist()
    call = {"type": "function", "function": {"name": "say", "arguments": {"text": "Yes, the red one."}}}
    rows[3] = [
        {"role": "user", "content": "No, the red one.", "style": None, "camera": None, "tool_calls": None},
        {"role": "assistant", "content": None, "style": None, "camera": None, "tool_calls": [json.dumps(call)]},
    ]
    fields = dict.fromkeys(("role", "content", "style", "camera"), pa.string()) | {"tool_calls": pa.list_(pa.string())}
    column = pa.array(rows, pa.list_(pa.struct(list(fields.items()))))
    pq.write_table(table.set_column(table.column_names.index("language_events"), "language_events", column), path)
    fast, slow = pair(root)
    assert_same(fast, slow)
    assert fast[3]["language_events"][1]["tool_calls"] == [call]
    assert len(fast[3]["language_persistent"]) > 3
    assert list(fast[3]["language_persistent"][0])[3] == "timestamp"
    assert fast[3]["language_persistent"][0] is not fast[4]["language_persistent"][0]


def test_the_example_of_the_docs_runs(root: Path) -> None:
    assert (
        run_examples("plugins/lerobot_policy_act_keypoints/README.md", "FastDataset", {"recordings/demo/dataset": root})
        == 1
    )

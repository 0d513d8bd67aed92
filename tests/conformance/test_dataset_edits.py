"""`demorec dataset` on datasets that LeRobot wrote and on our own, with the installed LeRobot as the judge."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import checked
from support.commands import exit_code
from support.datasets import TOP, items, same, write_with_lerobot
from support.export import data_table

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")
KINDS: dict[str, dict[str, Any]] = {
    "video": {},
    "images": {"video": False},
    "streaming": {"streaming_encoding": True},
}


edit = partial(exit_code, "dataset")


@pytest.fixture(
    scope="module", params=["video", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("images", "streaming"))]
)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_with_lerobot(tmp_path_factory.mktemp("made") / "d", **KINDS[request.param])


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_with_lerobot(tmp_path_factory.mktemp("small") / "d", episodes=5)


def statistics_are_exact(root: Path) -> None:
    """Those of numbers, against NumPy's of all rows."""
    found = json.loads((root / "meta/stats.json").read_text())
    for name in ("observation.state", "action", "index"):
        values = np.array(data_table(root).column(name).to_pylist(), dtype=np.float64)
        values = values.reshape(len(values), -1)
        expected = {"mean": values.mean(0), "std": values.std(0), "min": values.min(0), "max": values.max(0)}
        expected |= {f"q{q:02d}": np.quantile(values, q / 100, axis=0) for q in (1, 10, 50, 90, 99)}
        for quantity, value in expected.items():
            assert np.allclose(found[name][quantity], value, rtol=1e-9, atol=1e-12), (name, quantity)


def test_what_is_kept_is_kept_bit_for_bit(dataset: Path, tmp_path: Path) -> None:
    before = items(dataset)
    edits: dict[str, tuple[list[object], list[tuple[int, int, int]]]] = {
        "select": (["--where", 'num_frames < 16 and "there" in task'], [(0, 0, 12), (2, 0, 14)]),
        "drop": (["--episodes", "0,2:4"], [(number, 0, 12 + number) for number in (1, 4, 5)]),
        "trim": (["--head", 3, "--tail", 2], [(number, 3, 10 + number) for number in range(6)]),
        "reorder": (["--order", "5,3,1,0,2,4"], [(number, 0, 12 + number) for number in (5, 3, 1, 0, 2, 4)]),
    }
    for command, (flags, expected) in edits.items():
        out = tmp_path / command
        assert edit(command, dataset, *flags, "--out", out) == 0
        found = items(out)
        assert len(found) == len(expected)
        for episode, (number, first, last) in zip(found, expected, strict=True):
            assert same(episode, before[number][first:last], but=("timestamp",)), (command, number)
            assert [float(item["timestamp"]) for item in episode] == pytest.approx(np.arange(last - first) / 10)
        statistics_are_exact(out)


@pytest.mark.parametrize("images", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.long])])
def test_the_results_are_clean(small: Path, tmp_path: Path, images: bool) -> None:
    assert edit("trim", small, "--head", 3, "--out", tmp_path / "trimmed", "--decode") == 0
    assert edit("shuffle", small, "--seed", 3, "--out", tmp_path / "shuffled") == 0
    for name in ("trimmed", "shuffled"):
        results = checked(tmp_path / name, "dataset", images=images).results
        assert not [result for result in results if result.level in ("fail", "warn")]


def test_decoded_statistics_are_those_of_the_images(small: Path, tmp_path: Path) -> None:
    assert edit("trim", small, "--head", 1, "--out", tmp_path / "t") == 0
    pixels = np.stack([item[TOP] for episode in items(tmp_path / "t") for item in episode]) / 255
    found = json.loads((tmp_path / "t/meta/stats.json").read_text())[TOP]
    for name, value in {"mean": pixels.mean((0, 2, 3)), "std": pixels.std((0, 2, 3))}.items():
        assert np.allclose(np.ravel(found[name]), value, atol=1e-6), name
    assert np.allclose(np.ravel(found["q90"]), np.quantile(pixels, 0.9, axis=(0, 2, 3)), atol=1e-9)


def test_idle_ends_are_cut_off(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert edit("trim", small, "--head", 0, "--tail", 0, "--out", tmp_path / "t") == 2  # nothing to cut is no request
    assert edit("trim", small, "--idle", "--idle-margin", 1, "--out", tmp_path / "t") == 0
    assert "episode 0: 2 frames cut at the beginning, 2 at the end" in capsys.readouterr().out
    assert [len(episode) for episode in items(tmp_path / "t")] == [8 + number for number in range(5)]


def test_features_and_tasks(small: Path, tmp_path: Path) -> None:
    before = items(small)
    assert edit("rename", small, f"{TOP}=observation.images.front", "action=act", "--out", tmp_path / "a") == 0
    assert edit("drop-features", tmp_path / "a", "act", "--out", tmp_path / "b") == 0
    assert (
        edit("set-task", tmp_path / "b", "--task", "push", "--where", "episode_index == 1", "--out", tmp_path / "c")
        == 0
    )
    found = items(tmp_path / "c")
    assert set(found[0][0]) == {"observation.state", "observation.images.front", "timestamp", "task"}
    assert np.array_equal(found[2][3]["observation.images.front"], before[2][3][TOP])
    assert [str(episode[0]["task"]) for episode in found[:3]] == ["put it there", "push", "put it there"]


def test_all_differences_are_named_and_a_mapping_solves_them(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert edit("rename", small, "action=act", "--out", tmp_path / "b") == 0
    capsys.readouterr()
    assert edit("merge", small, tmp_path / "b", "--out", tmp_path / "m") == 2
    told = capsys.readouterr()
    assert all(words in told.err for words in ("has no action", "has act, which the first one has not"))
    assert "drop = " in told.out
    mapping = tmp_path / "m.toml"
    mapping.write_text(
        f'[[dataset]]\npath = "{tmp_path / "b"}"\n[dataset.feature.action]\nfrom = "act"\n'
        '[dataset.feature."observation.state"]\nelements = ["z", "y", "x"]\nunit = "degree"\n'
    )
    assert edit("merge", small, tmp_path / "b", "--mapping", mapping, "--out", tmp_path / "m") == 0
    found, before = items(tmp_path / "m"), items(small)
    assert all(same(a, b) for a, b in zip(found, before, strict=False))
    state, was = found[7][6]["observation.state"], before[2][6]["observation.state"]
    assert state == pytest.approx(np.deg2rad(was[::-1]))
    assert np.array_equal(found[7][6]["action"], before[2][6]["action"])


@pytest.mark.parametrize(
    ("condition", "told"),
    [("num_framse < 3", "num_frames"), ("__import__('os')", "nothing else"), ("length <", "no condition"),
     ("task < 3", "cannot be compared"), ("[x for x in tasks]", "nothing else")],
)  # fmt: skip
def test_conditions_are_parsed_and_never_run(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], condition: str, told: str
) -> None:
    assert edit("select", small, "--where", condition, "--out", tmp_path / "o") == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "o").exists()

"""`demorec dataset` on datasets of all kinds that LeRobot wrote; the installed LeRobot verifies the results."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_datasets import DEPTH, write_by_lerobot
from support.check import checked
from support.commands import exit_code
from support.datasets import TOP, items, same, write_with_lerobot
from support.export import data_table

pytestmark = [
    pytest.mark.usefixtures("hf_datasets_cache"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]
LENGTHS = [12 + number for number in range(6)]
edit = partial(exit_code, "dataset")


def in_small_files(root: Path) -> Path:
    """A dataset with several files of rows and of images."""
    write_with_lerobot(root, data_files_size_in_mb=0.002, video_files_size_in_mb=0.004)
    assert min(len(list(root.glob(f"{kind}/**/file-*"))) for kind in ("data", "videos")) > 2
    return root


def of_all_types(root: Path) -> Path:
    """A dataset with depth, two-dimensional arrays, text and several files."""
    return write_by_lerobot(root, LENGTHS, depth=True)


KINDS: dict[str, Callable[[Path], Path]] = {
    "video": write_with_lerobot,
    "images": partial(write_with_lerobot, video=False),
    "streaming": partial(write_with_lerobot, streaming_encoding=True),
    "small files": in_small_files,
    "all types": of_all_types,
}


@pytest.fixture(
    scope="module",
    params=[kind if kind == "video" else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS],
)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return KINDS[request.param](tmp_path_factory.mktemp("made") / "d")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_with_lerobot(tmp_path_factory.mktemp("small") / "d", episodes=5)


def statistics_are_exact(root: Path) -> None:
    """Check the statistics of numeric features against NumPy over all rows."""
    found = json.loads((root / "meta/stats.json").read_text())
    for name in ("observation.state", "action", "index"):
        values = np.array(data_table(root).column(name).to_pylist(), dtype=np.float64)
        values = values.reshape(len(values), -1)
        expected = {"mean": values.mean(0), "std": values.std(0), "min": values.min(0), "max": values.max(0)}
        expected |= {f"q{q:02d}": np.quantile(values, q / 100, axis=0) for q in (1, 10, 50, 90, 99)}
        for quantity, value in expected.items():
            assert np.allclose(found[name][quantity], value, rtol=1e-9, atol=1e-12), (name, quantity)


def test_kept_data_is_bit_exact(dataset: Path, tmp_path: Path) -> None:
    before, fps = items(dataset), json.loads((dataset / "meta/info.json").read_text())["fps"]
    word = str(before[0][0]["task"]).split()[-1]
    there = [number for number in range(4) if word in str(before[number][0]["task"])]
    edits: list[tuple[str, list[object], list[tuple[int, int, int]]]] = [
        ("select", ["--where", f'num_frames < 16 and "{word}" in task'], [(k, 0, 12 + k) for k in there]),
        ("drop", ["--episodes", "0,2:4"], [(number, 0, 12 + number) for number in (1, 4, 5)]),
        ("trim", ["--head", 3, "--tail", 2], [(number, 3, 10 + number) for number in range(6)]),
        ("trim", ["--head", 1], [(number, 1, 12 + number) for number in range(6)]),
        ("reorder", ["--order", "5,3,1,0,2,4"], [(number, 0, 12 + number) for number in (5, 3, 1, 0, 2, 4)]),
    ]
    for place, (command, flags, expected) in enumerate(edits):
        out = tmp_path / str(place)
        assert edit(command, dataset, *flags, "--out", out) == 0
        found = items(out)
        assert len(found) == len(expected)
        for episode, (number, first, last) in zip(found, expected, strict=True):
            assert same(episode, before[number][first:last], but=("timestamp",)), (command, number)
            assert [float(item["timestamp"]) for item in episode] == pytest.approx(np.arange(last - first) / fps)
        statistics_are_exact(out)


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["all types"], indirect=True)
def test_statistics_of_arrays_are_those_of_their_last_dimension(dataset: Path, tmp_path: Path) -> None:
    """LeRobot computes them the same way, so its own dataset is the reference.

    Depth statistics are those of decoded images.
    """
    assert edit("trim", dataset, "--head", 1, "--out", tmp_path / "t") == 0
    shapes = [
        {name: [np.shape(value) for value in entry.values()] for name, entry in statistics(path).items()}
        for path in (dataset, tmp_path / "t")
    ]
    assert shapes[0] == shapes[1]
    found, shown = statistics(tmp_path / "t"), [item for episode in items(tmp_path / "t") for item in episode]
    grids = np.stack([item["observation.grid"] for item in shown]).reshape(-1, 3).astype(np.float64)
    assert found["observation.grid"]["count"] == [len(shown)]
    for quantity, value in {"mean": grids.mean(0), "max": grids.max(0), "q90": np.quantile(grids, 0.9, 0)}.items():
        assert np.allclose(found["observation.grid"][quantity], value, rtol=1e-9), quantity
    depth = np.stack([item[DEPTH] for item in shown]).astype(np.float64)
    assert depth.mean() / 1000 == pytest.approx(np.ravel(found[DEPTH]["mean"])[0], rel=1e-5)  # LeRobot decodes to mm
    results = {result.check: result for result in checked(tmp_path / "t", "dataset", images=False).results}
    assert results["wrong_statistics"].verdict == "good", results["wrong_statistics"]


def statistics(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / "meta/stats.json").read_text())
    return found


@pytest.mark.parametrize("images", [False, pytest.param(True, marks=[pytest.mark.slow, pytest.mark.long])])
def test_the_results_are_clean(small: Path, tmp_path: Path, images: bool) -> None:
    assert edit("trim", small, "--head", 3, "--out", tmp_path / "trimmed", "--decode") == 0
    assert edit("shuffle", small, "--seed", 3, "--out", tmp_path / "shuffled") == 0
    for name in ("trimmed", "shuffled"):
        results = checked(tmp_path / name, "dataset", images=images).results
        assert not [result for result in results if result.verdict in ("broken", "look")]


def test_decoded_statistics_are_those_of_the_images(small: Path, tmp_path: Path) -> None:
    assert edit("trim", small, "--head", 1, "--out", tmp_path / "t") == 0
    pixels = np.stack([item[TOP] for episode in items(tmp_path / "t") for item in episode]) / 255
    found = json.loads((tmp_path / "t/meta/stats.json").read_text())[TOP]
    for name, value in {"mean": pixels.mean((0, 2, 3)), "std": pixels.std((0, 2, 3))}.items():
        assert np.allclose(np.ravel(found[name]), value, atol=1e-6), name
    assert np.allclose(np.ravel(found["q90"]), np.quantile(pixels, 0.9, axis=(0, 2, 3)), atol=1e-9)


def test_idle_ends_are_cut_off(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert edit("trim", small, "--head", 0, "--tail", 0, "--out", tmp_path / "t") == 2  # cuts nothing
    assert edit("trim", small, "--idle", "--idle-margin", 1, "--out", tmp_path / "t") == 0
    assert "episode 0: 2 frames cut at the beginning, 2 at the end" in capsys.readouterr().out
    assert [len(episode) for episode in items(tmp_path / "t")] == [8 + number for number in range(5)]


@pytest.mark.slow
def test_all_differences_are_named_and_a_mapping_solves_them(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert edit("rename", small, "action=act", "--out", tmp_path / "b") == 0
    capsys.readouterr()
    assert edit("merge", small, tmp_path / "b", "--out", tmp_path / "m") == 2
    told = capsys.readouterr()
    assert all(words in told.err for words in ("has no action", "has act, which the first one lacks"))
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
    [("num_framse < 3", "num_frames"), ("__import__('os')", "nothing else"), ("length <", "not a condition"),
     ("task < 3", "cannot be compared"), ("[x for x in tasks]", "nothing else")],
)  # fmt: skip
def test_conditions_are_parsed_and_never_run(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], condition: str, told: str
) -> None:
    assert edit("select", small, "--where", condition, "--out", tmp_path / "o") == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "o").exists()

"""`demorec dataset` on streams with reordered images, depth, several files, arrays: LeRobot is the judge."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.stream import VideoStream
from lerobot_datasets import DEPTH, write_by_lerobot
from support.check import checked
from support.commands import exit_code
from support.datasets import TOP, items, same, write_with_lerobot

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("hf_datasets_cache"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]
LENGTHS = [12 + number for number in range(6)]


def edit(*words: object) -> None:
    assert exit_code("dataset", *words) == 0


def reordered(root: Path) -> Path:
    """A dataset whose images are stored in another order than they are shown in."""
    write_with_lerobot(root)
    (path,) = root.glob(f"videos/{TOP}/*/*.mp4")
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    begins = np.cumsum([0, *LENGTHS])
    with av.open(str(path), "w") as out:
        # A group of images for each episode, as libx264 chooses it: with up to three images between two others.
        stream = out.add_stream("libx264", rate=10, options={"g": "250", "bf": "3", "qp": "12", "b-adapt": "0"})
        assert isinstance(stream, VideoStream)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = number
            if number in begins:
                frame.pict_type = av.video.frame.PictureType.I
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert any(a.pts > b.pts for a, b in pairwise(packets))  # type: ignore[operator]
    return root


def in_small_files(root: Path) -> Path:
    """A dataset with several files of rows and of images."""
    write_with_lerobot(root, data_files_size_in_mb=0.002, video_files_size_in_mb=0.004)
    assert min(len(list(root.glob(f"{kind}/**/file-*"))) for kind in ("data", "videos")) > 2
    return root


def of_all_types(root: Path) -> Path:
    """A dataset with depth, arrays of two dimensions, texts and several files."""
    return write_by_lerobot(root, LENGTHS, depth=True)


MADE: dict[str, Callable[[Path], Path]] = {
    "reordered": reordered,
    "small files": in_small_files,
    "all types": of_all_types,
}


@pytest.fixture(scope="module", params=MADE)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    root = MADE[request.param](tmp_path_factory.mktemp("made") / "d")
    return root, items(root)


@pytest.mark.parametrize(("head", "tail"), [(3, 2), (1, 0)])
def test_trimmed(made: tuple[Path, Any], tmp_path: Path, head: int, tail: int) -> None:
    root, before = made
    edit("trim", root, "--head", head, "--tail", tail, "--out", tmp_path / "t")
    found = items(tmp_path / "t")
    for episode, was in zip(found, before, strict=True):
        assert same(episode, was[head : len(was) - tail], but=("timestamp",))


def test_in_another_order_and_in_parts(made: tuple[Path, Any], tmp_path: Path) -> None:
    root, before = made
    edit("reorder", root, "--order", "5,0,3,1,4,2", "--out", tmp_path / "r")
    edit("split", tmp_path / "r", "--shares", "a=0.5", "b=0.5", "--out", tmp_path / "s")
    edit("merge", tmp_path / "s/a", tmp_path / "s/b", "--out", tmp_path / "m")
    edit("drop", tmp_path / "m", "--where", "num_frames == 14", "--out", tmp_path / "d")
    found = {len(episode): episode for episode in items(tmp_path / "d")}
    assert sorted(found) == [12, 13, 15, 16, 17]
    assert all(same(found[len(was)], was) for was in before if len(was) != 14)


@pytest.mark.parametrize("made", ["all types"], indirect=True)
def test_statistics_of_arrays_are_those_of_their_last_dimension(made: tuple[Path, Any], tmp_path: Path) -> None:
    """As LeRobot has them, whose own dataset is the model; with depth, whose mean is that of what LeRobot decodes."""
    root, _ = made
    edit("trim", root, "--head", 1, "--out", tmp_path / "t")
    shapes = [
        {name: [np.shape(value) for value in entry.values()] for name, entry in statistics(path).items()}
        for path in (root, tmp_path / "t")
    ]
    assert shapes[0] == shapes[1]
    found, shown = statistics(tmp_path / "t"), [item for episode in items(tmp_path / "t") for item in episode]
    grids = np.stack([item["observation.grid"] for item in shown]).reshape(-1, 3).astype(np.float64)
    assert found["observation.grid"]["count"] == [len(shown)]
    for quantity, value in {"mean": grids.mean(0), "max": grids.max(0), "q90": np.quantile(grids, 0.9, 0)}.items():
        assert np.allclose(found["observation.grid"][quantity], value, rtol=1e-9), quantity
    depth = np.stack([item[DEPTH] for item in shown]).astype(np.float64)
    assert depth.mean() / 1000 == pytest.approx(np.ravel(found[DEPTH]["mean"])[0], rel=1e-5)  # LeRobot decodes to mm
    results = {result.check: result.level for result in checked(tmp_path / "t", "dataset", images=False).results}
    assert results["dataset_statistics"] == "pass"


def statistics(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / "meta/stats.json").read_text())
    return found

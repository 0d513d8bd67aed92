"""Columns as arrays, the cache of frames and open video files, each by itself."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray


@given(
    lengths=st.lists(st.integers(1, 5), min_size=1, max_size=6),
    rows=st.lists(st.integers(0, 10**6), max_size=12),
    joined=st.booleans(),
)
def test_rows_are_taken_from_any_chunks(lengths: list[int], rows: list[int], joined: bool) -> None:
    from demorec.learn.training import columns
    from demorec.learn.training.columns import Column

    values = np.arange(3 * sum(lengths), dtype=np.float32).reshape(-1, 3)
    chunks = np.split(values, np.cumsum(lengths)[:-1])
    wanted = np.array([row % len(values) for row in rows], np.int64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "_JOINED_BYTES", 1 << 20 if joined else 0)
        column = Column(chunks)
    assert len(column) == len(values)
    assert np.array_equal(column.take(wanted), values[wanted])
    assert np.array_equal(column.take(wanted.reshape(1, -1)), values[wanted][None])


@pytest.mark.parametrize(
    "array",
    [
        pa.array(["a", "b"]),
        pa.array([1.0, None]),
        pa.array([[1.0], [2.0, 3.0]]),
        pa.array([[1.0, None], [2.0, 3.0]]),
        pa.array([[[1.0], [2.0, 3.0]], [[1.0, 2.0], [3.0]]]),
        pa.array([[], []], pa.list_(pa.float32())),
        pa.array([1 << 63, 2], pa.uint64()),
        pa.array([{"bytes": b"x"}, {"bytes": b"y"}]),
        pa.array([1, 2], pa.timestamp("s")),
    ],
)
def test_what_is_no_array_of_numbers_is_left_to_lerobot(array: pa.Array) -> None:
    from demorec.learn.training.columns import numbers

    assert numbers(pa.chunked_array([array])) is None


def test_what_was_wanted_lately_is_kept() -> None:
    import torch

    from demorec.learn.training.images import DecodedFrame, FrameCache

    cache = FrameCache(20)
    for number in (0, 1):
        cache.put("a", number, DecodedFrame(torch.zeros(10, dtype=torch.uint8), 0.0))
    cache.get("a", 0)
    cache.put("a", 2, DecodedFrame(torch.zeros(10, dtype=torch.uint8), 0.0))
    assert [cache.get("a", number) is not None for number in range(3)] == [True, False, True]


def write_video(path: Path, count: int, **options: str) -> list[NDArray[np.uint8]]:
    """A video of grey images by x264, and its images as PyAV decodes them from first to last."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"sc_threshold": "0", **options})
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for number in range(count):
            image = np.random.default_rng(number).integers(0, 255, (4, 4, 3), np.uint8)
            frame = av.VideoFrame.from_ndarray(np.kron(image, np.ones((8, 8, 1), np.uint8)), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    video = av.open(str(path))
    images = [np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8) for frame in video.decode(video=0)]
    video.close()
    return images


@pytest.mark.parametrize("options", [{"g": "2", "bf": "0"}, {"g": "9", "bf": "3"}, {"g": "100"}], ids=str)
def test_any_frames_in_any_order_are_those_of_a_straight_decoding(options: dict[str, str], tmp_path: Path) -> None:
    from demorec.learn.training.images import VideoFile

    images = write_video(tmp_path / "v.mp4", 40, **options)
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert any(packet.pts != packet.dts for packet in container.demux(video=0)) is (options.get("bf") != "0")
    file = VideoFile(str(tmp_path / "v.mp4"), "rgb24")
    rng = np.random.default_rng(0)
    for _ in range(12):
        wanted = sorted(rng.choice(40, rng.integers(1, 6), replace=False).tolist())
        assert file.numbers(np.array(wanted) / 30 + 1e-3).tolist() == wanted
        for number, frame in file.decode(wanted):
            assert frame.time_s == pytest.approx(number / 30)
            assert np.array_equal(frame.image.numpy().transpose(1, 2, 0), images[number])
    file.close()


def test_frames_of_a_batch_are_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from demorec.learn.training.images import VideoFile

    write_video(tmp_path / "v.mp4", 40, g="10", bf="0")
    file = VideoFile(str(tmp_path / "v.mp4"), "rgb24")
    passed: list[int] = []

    find_number = file._number

    def counting(pts: int | None) -> float:
        passed.append(int(find_number(pts)))
        return find_number(pts)

    monkeypatch.setattr(file, "_number", counting)
    assert [number for number, _ in file.decode([3, 5, 12, 38])] == [3, 5, 12, 38]
    # Each from its key frame on, or from where the one before has ended.
    assert passed == [*range(6), *range(10, 13), *range(30, 39)]
    file.close()

"""Reading and writing a longer episode needs no more memory."""

from __future__ import annotations

import tracemalloc
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from support.external import TOP, make_external
from support.recording import make_episode

from demorec.episode.episode import frame_time_ns
from demorec.extensions.recorder.sampled_writer import SampledWriter
from demorec.mcap import EpisodeWriter, Recording

READERS: dict[str, Callable[[Recording], Iterable[object]]] = {
    "packets": lambda recording: recording.packets("front"),
    "images": lambda recording: recording.images("front"),
    "depth": lambda recording: recording.depth("front"),
    "segmentation": lambda recording: recording.segmentation("front"),
    "joint_samples": lambda recording: recording.joint_samples(),
}


def write_long(path: Path, num_frames: int) -> None:
    """Write the same 60 frames repeatedly."""
    info, frames, outcome = make_episode(
        num_frames=60, width=64, height=64, cameras=("front",), depth=True, segmentation=True
    )
    with EpisodeWriter(path, info) as writer:
        for index in range(num_frames):
            writer.write(replace(frames[index % 60], frame_index=index, time_ns=frame_time_ns(index, info.fps)))
        writer.finish(replace(outcome, num_frames=num_frames))


def read_through(read: Callable[[Recording], Iterable[object]], recording: Recording) -> None:
    deque(read(recording), maxlen=1)


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    peaks: dict[str, list[int]] = {"writing": [], **{name: [] for name in READERS}}
    for count in (10, 90, 360):  # the first call loads and compiles
        path = tmp_path / f"{count}.mcap"
        peaks["writing"].append(peak_bytes(partial(write_long, path, count)))
        with Recording(path) as recording:
            assert recording.num_frames == count
            for name, read in READERS.items():
                peaks[name].append(peak_bytes(partial(read_through, read, recording)))
    for name, (_, short, long) in peaks.items():
        assert long < 1.3 * short + 200_000, name


def test_numbers_of_an_external_episode_are_read_without_its_images(tmp_path: Path) -> None:
    given = make_external(cameras=(replace(TOP, kept="jpeg"),), num_frames=120)
    noise = np.random.default_rng(0)
    num_bytes = 0
    with SampledWriter(tmp_path / "a.mcap", given.info) as writer:
        for number, frame in enumerate(given.frames):
            num_bytes += 200_000
            assert writer.image("top", frame.time_ns, noise.bytes(200_000)) == number
            writer.write(frame)
        writer.finish(given.outcome)
    with Recording(tmp_path / "a.mcap") as recording:
        # A chunk has the images of a second, both compressed and unpacked.
        assert peak_bytes(recording.table) < num_bytes * 0.7
        stamps = recording.table().image_stamps["top"].tolist()
    assert stamps == [frame.time_ns for frame in given.frames]

"""`kill -9` at any moment of writing loses at most the last second of the episode.

Each child writes a long episode and notes in a pipe the number of frames that it has handed to the recorder. It is
killed a few milliseconds after a random number of them, and the frames that `recover` keeps are compared with those
written.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from support.recording import Codec, frame_number, make_episode, write_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import Frame
from demorec.episode.info import EpisodeInfo
from demorec.extensions.recovery.recover import recover
from demorec.mcap import EpisodeWriter, Recording

FPS = 30
MOST_FRAMES = 300


def write_until_killed(path: Path, info: EpisodeInfo, frames: list[Frame], video: VideoConfig, notes: int) -> None:
    """Write frames, each as soon as the previous one is written, and note every one in the pipe."""
    os.write(notes, b"r")
    with EpisodeWriter(path, info, video=video) as writer:
        for frame in frames:
            writer.write(frame)
            os.write(notes, b"f")
            time.sleep(0.0005)


def kill_while(write: Callable[[int], None], *, after: int, seconds: float) -> int:
    """Run `write` in a child, kill it `seconds` after it noted `after` frames, and return how many it had written."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        try:
            write(write_end)
        finally:
            os._exit(0)
    os.close(write_end)
    written = -1  # the first note means that it has started
    try:
        while written < after:
            noted = os.read(read_end, after - written)
            assert noted, "the child ended by itself"
            written += len(noted)
        time.sleep(seconds)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    with os.fdopen(read_end, "rb") as notes:
        return written + len(notes.read())


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["h264", pytest.param("av1", marks=pytest.mark.long)])
def test_kill_at_random_moments(tmp_path: Path, codec: Codec) -> None:
    rng, kills = random.Random(5), 5
    info, frames, _ = make_episode(num_frames=2 * MOST_FRAMES, fps=FPS)
    write_episode(tmp_path / "warm.mcap", num_frames=2)  # compile and load libraries first
    kept_nothing = written_total = 0
    for number in range(kills):
        part = tmp_path / f"{number}.mcap.part"
        written = kill_while(
            partial(write_until_killed, part.with_suffix(""), info, frames, VideoConfig(codec=codec)),
            after=rng.randrange(MOST_FRAMES),
            seconds=rng.uniform(0.0, 0.01),  # anywhere within the writing of a frame
        )
        written_total += written
        assert not part.with_suffix("").exists()
        try:
            recovered = recover(part, part.with_suffix(""))
        except RecordingError:
            kept = 0
            kept_nothing += 1
        else:
            kept = recovered.num_frames
            assert not recovered.is_complete
            with Recording(recovered.path) as recording:
                assert recording.outcome is None
                assert recording.is_recovered
                assert recording.table().num_frames == kept
                for camera in recording.cameras:
                    numbers = [frame_number(image) for image in recording.images(camera)]
                    assert numbers == [index % 256 for index in range(kept)]
                assert recording.pixel_statistics("front").num_images == (kept + 1) // 2
        # The frame that was being written when the signal came may be in the file without having been noted.
        assert kept <= written + 1
        assert written - kept <= FPS, f"{written} frames written, {kept} kept"
    assert written_total > kills * FPS  # most were killed in the middle, not before the beginning
    assert kept_nothing < kills / 2

"""A program that records with `Recorder`: killed, out of disk, interrupted twice.

It records until there are three episodes. Finished episodes never change, and one that was cut off is completed when
the program runs again.
"""

from __future__ import annotations

import os
import signal
import sys
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from support.crash import Ended, SmallDisk, on_small_disk, run_command
from support.export import files_of

from demorec import Recorder
from demorec.core.errors import DemorecError
from demorec.mcap import Recording

NUM_EPISODES, NUM_FRAMES, FPS = 3, 30, 10
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]


def record(words: list[str]) -> None:
    """Record into the folder given as the only argument, and exit as a command does."""
    stamps = count(0, 1_000_000_000 // FPS)
    pixels = np.zeros((16, 16, 3), np.uint8)
    try:
        recorder = Recorder(
            *words, robot=["a"], cameras={"top": (16, 16)}, fps=FPS, task="wave", clock=lambda: next(stamps),
            when_full="wait",
        )  # fmt: skip
        with recorder:
            while recorder.num_episodes < NUM_EPISODES:
                with recorder.episode() as episode:
                    for frame in range(NUM_FRAMES):
                        episode.write([frame + 0.5], images={"top": pixels})
                    episode.success = True
    except DemorecError as error:
        print(f"demorec record: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0)


def run(folder: Path, **arguments: object) -> Ended:
    return run_command(["run"], folder, program=record, **arguments)


def finished(folder: Path) -> dict[str, bytes]:
    """Name -> content of each recording."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("run/episodes/*.mcap"))}


def num_frames(path: Path) -> int:
    """Return the number of frames of a recording, after comparing them with the given ones."""
    with Recording(path) as recording:
        values = recording.table().features["observation.state"][:, 0]
        assert np.array_equal(values, np.arange(len(values)) + 0.5)
        is_interrupted = recording.outcome is not None and recording.outcome.failure_reason == "interrupted"
        assert len(values) == NUM_FRAMES or recording.is_recovered or is_interrupted
        return len(values)


@pytest.fixture
def num_changes(tmp_path: Path) -> int:
    """Number of file-system changes of an undisturbed program."""
    (tmp_path / "undisturbed").mkdir()
    ended = run(tmp_path / "undisturbed")
    assert ended.code == 0
    assert len(finished(tmp_path / "undisturbed")) == NUM_EPISODES
    return ended.num_changes


def interrupt_twice(number: int) -> None:
    if number < 2:
        os.kill(os.getpid(), signal.SIGINT)


def check_again(folder: Path, told: object) -> None:
    """Run the program again: finished episodes stay, those cut off are completed, and nothing unfinished is left."""
    before = finished(folder)
    ended = run(folder)
    assert ended.code == 0, (told, ended.said)
    after = finished(folder)
    assert len(after) == NUM_EPISODES, told
    assert before.items() <= after.items(), told
    for name in after:
        assert num_frames(folder / "run/episodes" / name)
    left = {name for name in files_of(folder) if name.endswith((".part", ".recovering"))}
    assert not left, told


def test_killed_at_six_moments(tmp_path: Path, num_changes: int) -> None:
    for moment in sorted({int(each) for each in np.linspace(1, num_changes, 6)}):
        folder = tmp_path / f"at_{moment}"
        folder.mkdir()
        ended = run(folder, at=moment, act=lambda number: os.kill(os.getpid(), signal.SIGKILL))
        assert ended.code == -signal.SIGKILL
        check_again(folder, moment)


def test_a_second_interrupt(tmp_path: Path, num_changes: int) -> None:
    for moment in (num_changes // 3, num_changes // 2, num_changes * 2 // 3):
        folder = tmp_path / f"at_{moment}"
        folder.mkdir()
        ended = run(folder, at=moment, act=interrupt_twice)
        assert ended.code == 130
        check_again(folder, moment)


def test_a_full_file_system(tmp_path: Path, num_changes: int) -> None:
    page = os.sysconf("SC_PAGE_SIZE")
    size = sum(len(content) for content in files_of(tmp_path / "undisturbed").values())

    def work(disk: SmallDisk) -> None:
        for share in (0, 1, 2):
            folder = disk.folder / str(share)
            folder.mkdir()
            disk.resize(disk.num_used + share * size // 3 // page * page)
            ended = run(folder)
            assert ended.code == 1
            assert len(ended.said) == 1
            assert "No space left on device" in ended.said[0]
            disk.resize()
            check_again(folder, share)

    (tmp_path / "disk").mkdir()
    on_small_disk(tmp_path / "disk", work)

"""Input that the writer refuses, and the files that it leaves after an error."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recording import make_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.episode.episode import Frame, Outcome
from demorec.extensions.recovery.recover import recover
from demorec.mcap import EpisodeWriter, Recording


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_all(writer: EpisodeWriter, frames: list[Frame], outcome: Outcome | None = None) -> None:
    for frame in frames:
        writer.write(frame)
    if outcome is not None:
        writer.finish(outcome)


def test_a_file_that_appears_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=3)
    path = tmp_path / "a.mcap"
    with EpisodeWriter(path, info) as writer:
        write_all(writer, frames)
        path.write_bytes(b"mine")
        with pytest.raises(ConfigError, match="has appeared"):
            writer.finish(outcome)
    assert path.read_bytes() == b"mine"
    recover(tmp_path / "a.mcap.part", tmp_path / "b.mcap")
    with Recording(tmp_path / "b.mcap") as recording:
        assert recording.outcome == outcome


def test_frames_come_in_order(tmp_path: Path) -> None:
    info, frames, _ = make_episode(num_frames=3, cameras=())
    with EpisodeWriter(tmp_path / "a.mcap", info) as writer:
        writer.write(frames[0])
        with pytest.raises(RecordingError, match=r"Frame 2 at 66666667 ns arrived instead of frame 1 at 33333333 ns"):
            writer.write(frames[2])
        with pytest.raises(RecordingError, match="Frame 1 at 7 ns"):
            writer.write(replace(frames[1], time_ns=7))


def test_images_are_complete(tmp_path: Path) -> None:
    info, frames, _ = make_episode(num_frames=2, depth=True)
    wrist = frames[1].images["wrist"]
    with EpisodeWriter(tmp_path / "b.mcap", info) as writer:
        writer.write(frames[0])
        with pytest.raises(RecordingError, match="depth image of the camera 'wrist' at frame 1 is missing"):
            writer.write(replace(frames[1], images={**frames[1].images, "wrist": replace(wrist, depth=None)}))
    with EpisodeWriter(tmp_path / "c.mcap", info) as writer:
        writer.write(frames[0])
        small = replace(wrist, color=np.zeros((24, 32, 3), dtype=np.uint8))
        with pytest.raises(RecordingError, match=r"colour image .* has shape \(24, 32, 3\).* of 64x48 pixels"):
            writer.write(replace(frames[1], images={**frames[1].images, "wrist": small}))


def test_an_impossible_preset_is_one_sentence(tmp_path: Path) -> None:
    info, frames, _ = make_episode(num_frames=1)
    with (
        EpisodeWriter(tmp_path / "a.mcap", info, video=VideoConfig(preset="quickest")) as writer,
        pytest.raises(ConfigError, match=r"libx264 .* preset quickest") as caught,
    ):
        writer.write(frames[0])
    assert "\n" not in str(caught.value)


def test_a_disk_that_fills_up_in_the_middle(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    info, frames, outcome = make_episode(num_frames=60, width=320, height=240)
    writer = EpisodeWriter(tmp_path / "a.mcap", info, video=VideoConfig(codec="jpeg"))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(RecordingError, match=r"cannot be written \(File too large\)"):
            write_all(writer, frames, outcome)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert names(tmp_path) == ["a.mcap.part"]
    # The MCAP library prints a line to the terminal for every message that it cannot write.
    assert capfd.readouterr().err == ""


def leftover(folder: Path, origin: str) -> bytes:
    """Leftover of a derived recording that was killed after its first second."""
    info, frames, _ = make_episode(num_frames=40, cameras=())
    with EpisodeWriter(folder / "a.mcap", replace(info, origin=origin)) as writer:
        write_all(writer, frames)
    return (folder / "a.mcap.part").read_bytes()


def test_the_same_rendering_replaces_the_rest_of_a_killed_one(tmp_path: Path) -> None:
    leftover(tmp_path, "render of 0123")
    info, frames, outcome = make_episode(num_frames=5, cameras=())
    with EpisodeWriter(tmp_path / "a.mcap", replace(info, origin="render of 0123")) as writer:
        write_all(writer, frames, outcome)
    assert names(tmp_path) == ["a.mcap"]
    assert Recording(tmp_path / "a.mcap").num_frames == 5


@pytest.mark.parametrize(("left", "new"), [("", ""), ("render of 4567", "render of 0123")])
def test_irreproducible_leftovers_stay(tmp_path: Path, left: str, new: str) -> None:
    before = leftover(tmp_path, left)
    info, _, _ = make_episode(num_frames=5, cameras=())
    with pytest.raises(ConfigError, match="unfinished recording"):
        EpisodeWriter(tmp_path / "a.mcap", replace(info, origin=new))
    assert (tmp_path / "a.mcap.part").read_bytes() == before


def test_files_being_written_by_another_process_are_left_alone(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=40, cameras=())
    info = replace(info, origin="render of 0123")
    with EpisodeWriter(tmp_path / "a.mcap", info) as writer:
        write_all(writer, frames)
        for overwrite in (False, True):
            with pytest.raises(ConfigError, match="Another process is writing"):
                EpisodeWriter(tmp_path / "a.mcap", info, overwrite=overwrite)
        writer.finish(outcome)
    assert Recording(tmp_path / "a.mcap").num_frames == 40


def test_a_writer_killed_before_its_first_frame_leaves_nothing_to_keep(tmp_path: Path) -> None:
    info, frames, outcome = make_episode(num_frames=5, cameras=())
    EpisodeWriter(tmp_path / "a.mcap", info).__exit__(None, None, None)
    part = tmp_path / "a.mcap.part"
    part.write_bytes(part.read_bytes()[:8])  # MCAP's magic bytes alone
    with EpisodeWriter(tmp_path / "a.mcap", info) as writer:
        write_all(writer, frames, outcome)
    assert names(tmp_path) == ["a.mcap"]

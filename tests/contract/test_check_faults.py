"""Faults, one at a time, in good recordings: each is caught by the check that is meant for it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import Message, Spoilt, checked, flip_bits, level_of, rewrite_messages, simulate

from demorec.mcap import channels, messages

Fault = Callable[[Spoilt], None]


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without images."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place with two cameras."""
    return simulate(tmp_path_factory.mktemp("filmed") / "filmed.mcap", seed=7, cameras=("front", "wrist"))


def test_the_good_ones_pass_without_a_warning(good: Path, filmed: Path) -> None:
    for path in (good, filmed):
        report = checked(path)
        assert [r for r in report.results if r.level in ("warn", "fail")] == []
        assert report.count("pass") > 25


# ------------------------------------------------------------------------------------------------- numbers


def wrong_fps(s: Spoilt) -> None:
    s.info = replace(s.info, fps=24)


def long_standstill(s: Spoilt) -> None:
    still = [len(s.frames) - 1] * (len(s.frames) * 2)
    s.frames = s.frames + still
    velocity = s.columns.joint_velocity.copy()
    velocity[-1] = 0.0
    s.set(joint_velocity=velocity)


def cut_off_in_mid_motion(s: Spoilt) -> None:
    s.frames = s.frames[: len(s.frames) * 3 // 5]


NUMBERS: list[tuple[Fault, str]] = [
    (wrong_fps, "velocity_matches_position"),
    (long_standstill, "idle_frames"),
    (cut_off_in_mid_motion, "final_state"),
]
"""Those that change which frames there are, or their times; `test_check_faults_numbers.py` has the others."""


@pytest.mark.parametrize(("fault", "check"), NUMBERS, ids=[f"{f.__name__}-{c}" for f, c in NUMBERS])
def test_spoilt_numbers(fault: Fault, check: str, good: Path, tmp_path: Path) -> None:
    assert level_of(good, check) == "pass"
    spoilt = Spoilt(good)
    fault(spoilt)
    assert level_of(spoilt.write(tmp_path / "spoilt.mcap"), check) == "fail"


# ------------------------------------------------------------------------------------------------- the file


def test_a_truncated_file(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    report = checked(tmp_path / "cut.mcap")
    assert report.level == "fail"
    assert report.results[0].check == "opens"
    assert report.results[0].level == "fail"
    assert all(result.level == "skip" for result in report.results[1:])


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_flipped_bits(place: float, good: Path, tmp_path: Path) -> None:
    size = good.stat().st_size
    spoilt = flip_bits(good, tmp_path / "flipped.mcap", offset=int(size * place))
    assert checked(spoilt, only=["opens", "checksums"]).level == "fail"


def test_an_index_with_flipped_bits(good: Path, tmp_path: Path) -> None:
    assert level_of(flip_bits(good, tmp_path / "flipped.mcap", offset=-200), "opens") == "fail"


def test_a_missing_topic(good: Path, tmp_path: Path) -> None:
    spoilt = rewrite_messages(good, tmp_path / "s.mcap", lambda m: [] if m[0] == channels.ACTION else [m])
    assert level_of(spoilt, "topics") == "fail"
    assert level_of(spoilt, "readable") == "fail"


def test_a_lost_message(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        return [] if m[0] == channels.COMMAND and m[3] == 2_000_000_000 else [m]

    assert level_of(rewrite_messages(good, tmp_path / "s.mcap", edit), "topics") == "fail"


def test_times_that_are_off(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        late = m[0] == channels.GRIPPER and m[3] > 1_000_000_000
        return [(m[0], m[1], m[2], m[3] + 1_000_000)] if late else [m]

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "frame_times") == "fail"


def test_stale_stamps(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        if m[0] != channels.EE_POSE or m[3] < 1_000_000_000:
            return [m]
        return [(m[0], m[1], m[2][:4] + struct.pack("<iI", 1, 0) + m[2][12:], m[3])]

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "stamps") == "fail"
    assert level_of(spoilt, "frame_times") == "pass"


def test_other_joint_names(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        return [(m[0], m[1], m[2].replace(b"panda_joint3", b"panda_jointX"), m[3])]

    assert level_of(rewrite_messages(good, tmp_path / "s.mcap", edit), "readable") == "fail"


def test_a_recovered_recording_is_a_warning(good: Path, tmp_path: Path) -> None:
    from demorec.mcap import recover

    part = tmp_path / "cut.mcap.part"
    part.write_bytes(good.read_bytes()[: int(good.stat().st_size * 0.7)])
    recover(part, tmp_path / "cut.mcap")
    assert level_of(tmp_path / "cut.mcap", "complete") == "warn"


# ------------------------------------------------------------------------------------------------- images


def upside_down(s: Spoilt) -> None:
    s.image("front", lambda t, p: p[::-1])


def mirrored_wrist(s: Spoilt) -> None:
    s.image("wrist", lambda t, p: p[:, ::-1])


def names_exchanged(s: Spoilt) -> None:
    front = [images["front"].color for images in s.images]
    wrist = [images["wrist"].color for images in s.images]
    s.image("front", lambda t, p: wrist[t])
    s.image("wrist", lambda t, p: front[t])


def one_camera_twice(s: Spoilt) -> None:
    front = [images["front"].color for images in s.images]
    s.image("wrist", lambda t, p: front[t])


def other_field_of_view(s: Spoilt) -> None:
    cameras = tuple(replace(camera, fov_y=camera.fov_y * 0.7) for camera in s.info.scene.cameras)
    s.info = s.info.with_simulation(scene=replace(s.info.scene, cameras=cameras))


def black_images(s: Spoilt) -> None:
    s.image("front", lambda t, p: p * 0 if 30 <= t < 33 else p)


def white_images(s: Spoilt) -> None:
    s.image("front", lambda t, p: p * 0 + 255 if t > 100 else p)


def burnt_images(s: Spoilt) -> None:
    s.image(
        "front",
        lambda t, p: np.where(np.arange(p.shape[1])[None, :, None] < p.shape[1] * 0.97, 255, p).astype(np.uint8),
    )


def images_two_frames_late(s: Spoilt) -> None:
    for camera in ("front", "wrist"):
        before = [images[camera].color for images in s.images]
        s.image(camera, lambda t, p, before=before: before[max(t - 2, 0)])  # type: ignore[misc]


def extrinsics_of_another_place(s: Spoilt) -> None:
    poses = {name: rows.copy() for name, rows in s.columns.world_from_camera.items()}
    poses["front"][:, 1] += 0.02
    s.set(world_from_camera=poses)


def camera_axes_of_opengl(s: Spoilt) -> None:
    # y up and z backward: half a turn about x.
    poses = {name: rows.copy() for name, rows in s.columns.world_from_camera.items()}
    x, y, z, w = poses["front"][:, 3:].T
    poses["front"][:, 3:] = np.stack([w, z, -y, -x], axis=1)
    s.set(world_from_camera=poses)


IMAGES: list[tuple[Fault, str]] = [
    (upside_down, "projection"),
    # Not projection: what the hand goes for and holds is in the middle of the wrist's images.
    (mirrored_wrist, "images_as_drawn"),
    (names_exchanged, "projection"),
    (one_camera_twice, "distinct_cameras"),
    (other_field_of_view, "image_placement"),
    (black_images, "exposure"),
    (white_images, "exposure"),
    (burnt_images, "exposure"),
    (images_two_frames_late, "image_lag"),
    (extrinsics_of_another_place, "extrinsics"),
    (camera_axes_of_opengl, "extrinsics"),
]


def images_with_slow_ones() -> Iterator[Any]:
    """Each fault with its check; of a check's faults the first one is quick enough to stand for it in `make test`."""
    known = set[str]()
    for fault, check in IMAGES:
        marks = pytest.mark.slow if check in known else ()
        known.add(check)
        yield pytest.param(fault, check, id=f"{fault.__name__}-{check}", marks=marks)


@pytest.mark.parametrize(("fault", "check"), list(images_with_slow_ones()))
def test_spoilt_images(fault: Fault, check: str, filmed: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(filmed)
    fault(spoilt)
    assert level_of(spoilt.write(tmp_path / "spoilt.mcap"), check) == "fail"


def test_encoding_again_alone_shows_in_the_quality_of_images_only(filmed: Path, tmp_path: Path) -> None:
    # What the faults above do besides their fault.
    report = checked(Spoilt(filmed).write(tmp_path / "again.mcap"))
    assert {r.check for r in report.results if r.level in ("warn", "fail")} <= {"image_colors", "image_errors"}


def test_a_wrong_k(filmed: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        if m[0] != channels.camera_topic("front", "camera_info"):
            return [m]
        _, k = messages.read_camera_info(m[2])
        old, new = struct.pack("<d", k[0, 2]), struct.pack("<d", k[0, 2] * 1.2)
        return [(m[0], m[1], m[2].replace(old, new), m[3])]

    spoilt = rewrite_messages(filmed, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "intrinsics") == "fail"
    assert level_of(spoilt, "projection") == "fail"


def test_a_lost_packet(filmed: Path, tmp_path: Path) -> None:
    topic = channels.video_topic("front", "h264")

    def edit(m: Message) -> list[Message]:
        return [] if m[0] == topic and m[3] == 2_000_000_000 else [m]

    spoilt = rewrite_messages(filmed, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "video_frames") == "fail"


def test_a_video_that_does_not_decode(filmed: Path, tmp_path: Path) -> None:
    topic = channels.video_topic("front", "h264")
    rng = np.random.default_rng(0)

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or m[3] < 3_000_000_000:
            return [m]
        # The bytes of the image come last; what tells where they begin stays.
        return [(m[0], m[1], m[2][:-300] + rng.integers(0, 255, 300, dtype=np.uint8).tobytes(), m[3])]

    assert level_of(rewrite_messages(filmed, tmp_path / "s.mcap", edit), "images_decode") == "fail"


def test_histograms_of_the_other_camera(filmed: Path, tmp_path: Path) -> None:
    topics = [channels.camera_topic(name, "histogram") for name in ("front", "wrist")]

    def edit(m: Message) -> list[Message]:
        return [(topics[1 - topics.index(m[0])], *m[1:])] if m[0] in topics else [m]

    assert level_of(rewrite_messages(filmed, tmp_path / "s.mcap", edit), "pixel_statistics") == "fail"

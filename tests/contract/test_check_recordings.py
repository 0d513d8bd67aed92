"""Faults in good recordings, one at a time: each is found by its own check."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import Message, Spoilt, checked, flip_bits, rewrite_messages, simulate, verdict_of
from support.commands import exit_code

from demorec.core.config import VideoConfig
from demorec.core.tables import FILE_CHECKS
from demorec.extensions.recovery.recover import recover
from demorec.mcap import channels

Fault = Callable[[Spoilt], None]
Rows = np.ndarray[Any, Any]
SECOND = 1_000_000_000


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without images."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place with two cameras."""
    return simulate(tmp_path_factory.mktemp("filmed") / "filmed.mcap", seed=7, cameras=("front", "wrist"))


def findings(path: Path) -> list[tuple[str, str]]:
    """Return the checks that do not pass."""
    return [(result.check, result.verdict) for result in checked(path).results if result.verdict in ("look", "broken")]


# ------------------------------------------------------------------------------------------------- good ones


def test_the_good_ones_pass(good: Path, filmed: Path) -> None:
    assert findings(good) == findings(filmed) == []
    assert {result.verdict for result in checked(filmed, only=FILE_CHECKS.names()).results} == {"good"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        {"task": "tutorial", "depth": True, "segmentation": True, "video": VideoConfig(codec="av1", crf=35)},
        {"robot": "so101", "variation": "full", "fps": 60, "video": VideoConfig(codec="jpeg", jpeg_quality=60)},
        {"task": "line_up", "robot": "iiwa", "variation": "full", "fps": 10, "width": 64, "height": 48},
    ],
    ids=str,
)
def test_images_of_every_kind_pass(config: dict[str, Any], tmp_path: Path) -> None:
    assert findings(simulate(tmp_path / "e.mcap", seed=24, cameras=("front", "wrist"), **config)) == []


# ------------------------------------------------------------------------------------------------- numbers


def column(name: str, change: Callable[[Rows], Rows]) -> Fault:
    return lambda s: s.set(**{name: change(getattr(s.columns, name).copy())})


def plus(where: Any, by: Any) -> Callable[[Rows], Rows]:
    def change(rows: Rows) -> Rows:
        rows[where] += by
        return rows

    return change


def frozen(rows: Rows) -> Rows:
    """Repeat the value at one third of the episode until its end."""
    rows[len(rows) // 3 :] = rows[len(rows) // 3]
    return rows


def frozen_wrench(s: Spoilt) -> None:
    s.set(sensed={**s.columns.sensed, "wrench": frozen(s.columns.sensed["wrench"].copy())})


def wrong_fps(s: Spoilt) -> None:
    s.info = replace(s.info, fps=24)


def scalar_first(rows: Rows) -> Rows:
    return rows[:, [0, 1, 2, 6, 3, 4, 5]]


NUMBERS: dict[str, tuple[Fault, str]] = {
    "a NaN": (column("joint_velocity", plus((40, 2), np.nan)), "missing_numbers"),
    "degrees": (column("joint_position", np.degrees), "joint_limits"),
    "another rate": (wrong_fps, "velocity_mismatch"),
    "velocities of another joint": (
        column("joint_velocity", lambda r: r[:, [1, 0, *range(2, r.shape[1])]]),
        "velocity_mismatch",
    ),
    "quaternions with the scalar first": (column("base_from_tcp", scalar_first), "pose_mismatch"),
    "a frozen wrench": (frozen_wrench, "frozen_sensors"),
    "a frozen encoder": (
        column("joint_position", lambda r: np.concatenate([r[:, :1], frozen(r[:, 1:2]), r[:, 2:]], axis=1)),
        "frozen_state",
    ),
    "actions ten frames early": (
        column("action_joint_target", lambda r: np.concatenate([r[10:], np.repeat(r[-1:], 10, axis=0)])), "action_lag"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NUMBERS)
def test_damaged_numbers(name: str, good: Path, tmp_path: Path) -> None:
    fault, check = NUMBERS[name]
    spoilt = Spoilt(good)
    fault(spoilt)
    assert verdict_of(spoilt.write(tmp_path / "spoilt.mcap"), check) in ("look", "broken")


def test_a_nan_spoils_its_frame_and_not_the_other_checks(good: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(good)
    spoilt.set(joint_position=plus((40, 2), np.nan)(spoilt.columns.joint_position.copy()))
    path = spoilt.write(tmp_path / "spoilt.mcap")
    assert findings(path) == [("missing_numbers", "broken")]
    (found,) = checked(path, only=["missing_numbers"]).results
    assert found.findings[0].message.startswith("observation.state has NaN or infinite numbers: ")
    spoilt.set(base_from_tcp=scalar_first(spoilt.columns.base_from_tcp.copy()))
    twice = dict(findings(spoilt.write(tmp_path / "twice.mcap")))
    assert twice == {"missing_numbers": "broken", "pose_mismatch": "broken"}


# ------------------------------------------------------------------------------------------------- the file


def test_a_truncated_file(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    report = checked(tmp_path / "cut.mcap")
    assert findings(tmp_path / "cut.mcap")[0] == ("opens", "broken")
    integrity = [result.verdict for result in report.results if result.check in FILE_CHECKS.names()]
    assert "broken" not in integrity[1:]


@pytest.mark.parametrize("place", [0.2, 0.5, 0.999])
def test_flipped_bits(place: float, good: Path, tmp_path: Path) -> None:
    spoilt = flip_bits(good, tmp_path / "flipped.mcap", offset=int(good.stat().st_size * place))
    assert checked(spoilt, only=["opens", "checksums"]).verdict == "broken"


def dropped(topic: str, at: int | None = None) -> Callable[[Message], list[Message]]:
    return lambda m: [] if m[0] == topic and at in (None, m[3]) else [m]


def doubled(topic: str, at: int) -> Callable[[Message], list[Message]]:
    return lambda m: [m, m] if m[0] == topic and m[3] == at else [m]


def exchanged_messages(m: Message) -> list[Message]:
    """Swap the messages of two frames."""
    times = {2 * SECOND: 3 * SECOND, 3 * SECOND: 2 * SECOND}
    return [(m[0], m[1], m[2], times[m[3]])] if m[0] == channels.EE_POSE and m[3] in times else [m]


def old_stamp(m: Message) -> list[Message]:
    if m[0] != channels.EE_POSE or m[3] < SECOND:
        return [m]
    return [(m[0], m[1], m[2][:4] + struct.pack("<iI", 1, 0) + m[2][12:], m[3])]


def a_millisecond_late(m: Message) -> list[Message]:
    is_late = m[0] == channels.GRIPPER and m[3] > SECOND
    return [(m[0], m[1], m[2], m[3] + 1_000_000)] if is_late else [m]


def other_joint_names(m: Message) -> list[Message]:
    return [(m[0], m[1], m[2].replace(b"panda_joint3", b"panda_jointX"), m[3])]


FILES: dict[str, Callable[[Message], list[Message]]] = {
    "a missing topic": dropped(channels.ACTION),
    "a lost message": dropped(channels.COMMAND, 2 * SECOND),
    "a doubled message": doubled(channels.COMMAND, 2 * SECOND),
    "messages in another order": exchanged_messages,
    "another clock": a_millisecond_late,
    "stale stamps": old_stamp,
    "other joint names": other_joint_names,
    "a lost packet": dropped(channels.video_topic("front", "h264"), 2 * SECOND),
}


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file(name: str, filmed: Path, tmp_path: Path) -> None:
    spoilt = rewrite_messages(filmed, tmp_path / "s.mcap", FILES[name])
    assert ("broken", True) in {(verdict, check in FILE_CHECKS.names()) for check, verdict in findings(spoilt)}
    assert exit_code("check", spoilt, "--no-images") == 1


@pytest.mark.parametrize("share", [1 / 3, 2 / 3])
def test_a_recovered_recording_is_a_warning(share: float, good: Path, tmp_path: Path) -> None:
    part = tmp_path / "cut.mcap.part"
    part.write_bytes(good.read_bytes()[: int(good.stat().st_size * share)])
    recover(part, tmp_path / "cut.mcap")
    assert findings(tmp_path / "cut.mcap") == [("complete", "look")]
    for args, code in (((), 0), (("--strict",), 1)):
        assert exit_code("check", tmp_path / "cut.mcap", *args) == code


# ------------------------------------------------------------------------------------------------- images


def test_a_video_that_does_not_decode(filmed: Path, tmp_path: Path) -> None:
    topic = channels.video_topic("front", "h264")
    rng = np.random.default_rng(0)

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or m[3] < 3 * SECOND:
            return [m]
        # The bytes of the image are at the end; its header stays intact.
        return [(m[0], m[1], m[2][:-300] + rng.integers(0, 255, 300, dtype=np.uint8).tobytes(), m[3])]

    assert verdict_of(rewrite_messages(filmed, tmp_path / "s.mcap", edit), "images_decode") == "broken"


# ------------------------------------------------------------------------------------------------- the command


def test_the_command(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for args in ((good, "--only", "joint_limit"), (tmp_path / "nothing",), ()):
        assert exit_code("check", *args) == 2, args
    assert exit_code("check", good, "--only", "opens", "joint_limits") == 0
    capsys.readouterr()
    assert exit_code("check", good, "--strict", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["findings"]) == ("good", [])
    assert found["taken"]["observation.state"] == "state"


def test_unmeasured_checks_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = simulate(tmp_path / "e.mcap", task="support.odd_tasks:FarAway", fps=10)
    assert exit_code("check", path) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "action_lag" in line)
    assert line.startswith("not measured: ")

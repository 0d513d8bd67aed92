"""Checks of third-party datasets find planted faults in a dataset not made by demorec, and pass without them.

All bases and faults: `benchmarks/doctor_faults.py`.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from support.doctor_bases import BASES, record
from support.doctor_faults import FAULTS
from support.doctor_judge import Bench, bench, check, episodes_of, findings_of, is_found
from support.doctor_writer import VideoStore, write_dataset


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Quantised teleoperation at 10 fps under openpi's names."""
    return bench(BASES["openpi"], tmp_path_factory.mktemp("doctor") / "openpi")


def test_a_sound_dataset_is_good(arm: Bench) -> None:
    answer = check(arm.folder / "sound")
    assert (answer["verdict"], findings_of(answer)) == ("good", [])


def test_a_parked_arm_with_the_rounding_of_lerobot_is_good(tmp_path: Path) -> None:
    """LeRobot's float32 gives a parked joint a nonzero deviation; its encoder flickers by one tick."""
    (tmp_path / "videos").mkdir()
    dataset = record(BASES["two arms"], seed=10, episodes=4)
    answer = check(write_dataset(dataset, tmp_path / "parked", VideoStore(tmp_path / "videos")))
    assert (answer["verdict"], findings_of(answer)) == ("good", [])


@pytest.mark.parametrize(
    "name",
    [
        "gap",
        "stuck state",
        "NaN",
        "unit of an episode",
        "dead joint",
        "maximum of the state",
        "action late",
        "copy",
        "empty instruction",
    ],
)
def test_a_planted_fault_is_found(arm: Bench, name: str) -> None:
    """The fault alone, with a second bad episode, and with a NaN in another episode."""
    for second in ("", "bad", "nan"):
        answer = check(arm.plant(name, second))
        assert is_found(FAULTS[name], answer, episodes_of(name), arm.alarms), (second, answer)

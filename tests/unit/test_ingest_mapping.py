"""Mappings: their valid content, and that all errors of one are reported at once."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support import bag_mappings, bags
from support.commands import exit_code

from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.fields import (
    FieldError,
    OtherPublisherError,
    follow,
    parse_path,
    reader_of,
)
from demorec.extensions.imports.import_run import import_bags
from demorec.extensions.imports.mapping import Source

WRONG = [
    ('fps = 30', 'fpss = 30', r"unknown key 'fpss' in clock. Did you mean 'fps'\?"),
    ('fps = 30', 'fps = "x"', r"'x' is not a whole number"),
    ('fps = 30', 'fps = 30\nstamp = "sensor"', r"'sensor' is not one of 'header', 'log'"),
    ('[robot]', '[episodes]\ngroup = "data"\n[robot]', r"unknown key 'episodes'"),
    ('fps = 30', 'fps = 30\nmax_age_s = 0', r"clock.max_age_s is 0, it must be above 0"),
    ('text = "stack the cups"', '', r"\[task\] needs one of text and file_name"),
    ('[features.action]', '[features.act]', r"missing feature 'action'"),
    ('[cameras.front]', '[cameras."a b"]', r"a camera is called 'a b', allowed are letters"),
    ('topic = "/leader/joint_states"', 'next = "observation.stat"', r"Did you mean 'observation.state'\?"),
    ('field = "position"\n[cam', 'field = "position"\nunit = "feet"\n[cam', r"'feet' is not one of"),
    ("/follower/joint_states", "/folower/joint_states", r"no message of '/folower/joint_states'. Did you mean '/foll"),
    ('field = "position"', 'field = "postion"', r"no field 'postion'. Did you mean 'position'\?"),
    ('field = "position"', 'field = "position"\njoints = ["shoulder_pam"]', r"Did you mean 'shoulder_pan'\?"),
    ('field = "position"', 'field = "position"\nelements = [9]', r"no element 9 among the 6"),
    ('field = "position"', 'field = "position"\nnames = ["a"]', r"names: 1 given for the 6 elements"),
    ("/follower/cam_front/image_raw/compressed", "/follower/joint_states", r"camera front .* it holds no image"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "told"), WRONG)
def test_a_wrong_mapping_is_refused(
    old: str, new: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mapping that is invalid by itself, or for the bag."""
    text = bag_mappings.SO101.replace(old, new, 1)
    assert text != bag_mappings.SO101
    bag = bags.write_mcap(bags.in_order(bags.so101(0.3)), tmp_path / "bag.mcap")
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") in (1, 2)
    err = capsys.readouterr().err
    assert re.search(told, err), err
    assert err.count("\n") == 1


def test_two_sources_with_the_same_names_are_refused(tmp_path: Path) -> None:
    bag = bags.write_mcap(bags.in_order(bags.so101(0.3)), tmp_path / "bag.mcap")
    source = '[[features."observation.state"]]\ntopic = "/follower/joint_states"\nfield = "position"\n'
    mapping = bag_mappings.write_mapping(bag_mappings.SO101.replace(source, source * 2), tmp_path / "robot.toml")
    with pytest.raises(BagError, match=r"2 elements of the feature 'observation.state' are called 'shoulder_pan'"):
        import_bags([bag], mapping, tmp_path / "run")


def test_paths_of_fields() -> None:
    values = {
        "transforms": [
            {"child_frame_id": "base", "transform": {"translation": {"x": 1.0}}},
            {"child_frame_id": "hand", "transform": {"translation": {"x": 2.0}}},
        ],
        "points": [{"positions": np.array([3.0, 4.0])}],
    }
    assert follow(values, parse_path("transforms[child_frame_id=hand].transform.translation.x")) == 2.0
    assert follow(values, parse_path("points[0].positions")).tolist() == [3.0, 4.0]
    assert follow(values, parse_path("transforms.transform.translation.x")).tolist() == [1.0, 2.0]
    with pytest.raises(FieldError, match="no element 1"):
        follow(values, parse_path("points[1].positions"))
    with pytest.raises(FieldError, match="not a field path"):
        parse_path("a[")


def test_publishers_of_velocities_alone_are_separate() -> None:
    """Wheels have no positions, which is no reason to refuse the arm whose messages follow."""
    source = Source(topic="/j", field="position", joints=("a",))
    with pytest.raises(OtherPublisherError):
        reader_of(source, {"name": ["wheel"], "position": np.empty(0), "velocity": np.array([1.0])})
    with pytest.raises(FieldError, match="have no names"):
        reader_of(source, {"position": np.array([1.0])})


def test_messages_of_another_publisher_are_a_finding_without_a_list_of_joints(tmp_path: Path) -> None:
    notes = bags.so101(0.3)
    notes += bags.joints("/follower/joint_states", ("wheel_left", "wheel_right"), bags.times(50, 0.3, seed=9))
    bag = bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap")
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml")
    (report,) = import_bags([bag], mapping, tmp_path / "run").reports
    (text,) = [finding.text for finding in report.findings if finding.kind == "malformed"]
    assert "15 messages cannot be used" in text
    assert "'wheel_left': select one publisher by joints" in text

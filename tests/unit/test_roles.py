"""Roles and names: the same motion is read alike under any names, and keeps its names when written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.check import edit_json
from support.commands import exit_code
from support.conventions import CONVENTIONS, Convention, write_convention

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.episode.element_names import read_names
from demorec.episode.roles import Column, NamedRoles, find_roles
from demorec.view.sources import find_episodes

Capture = pytest.CaptureFixture[str]
UNKNOWN = Convention({"measured": (None, (0, 1, 2, 3))}, {"wanted": (None, (0, 1, 2, 3))})
"""Names outside of all conventions: the user must name state and action."""
NAMED = ("--state", "measured", "--action", "wanted")


def diagnosis(capsys: Capture, *words: object) -> dict[str, Any]:
    """Return the findings of `demorec check`."""
    capsys.readouterr()
    exit_code("check", *words, "--no-images", "--json")
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def found_by(found: dict[str, Any], check: str) -> list[dict[str, Any]]:
    return [finding for finding in found["findings"] if finding["check"] == check]


@pytest.mark.parametrize("name", CONVENTIONS)
def test_motion_is_checked_whatever_the_features_are_called(name: str, tmp_path: Path, capsys: Capture) -> None:
    good = diagnosis(capsys, write_convention(tmp_path / "good", CONVENTIONS[name]))
    assert {name for name, role in good["taken"].items() if role is None} == set()
    assert not {"action_lag", "frozen_state"} & {each["check"] for each in good["not_measured"]}
    assert not found_by(good, "action_lag")
    assert not found_by(good, "frozen_state")
    bad = diagnosis(capsys, write_convention(tmp_path / "bad", CONVENTIONS[name], frozen=True))
    (finding,) = found_by(bad, "frozen_state")
    assert (finding["severity"], finding["episode"]) == ("broken", 2)
    is_named = CONVENTIONS[name].state.get("observation.state", (None,))[0] is not None
    assert not is_named or finding["message"].startswith("elbow")
    assert bad["episodes"][0]["episode"] == 2


@pytest.mark.parametrize("name", CONVENTIONS)
def test_an_import_keeps_the_found_roles(name: str, tmp_path: Path, capsys: Capture) -> None:
    root, run = write_convention(tmp_path / "d", CONVENTIONS[name]), tmp_path / "run"
    assert exit_code("info", root, "--json") == 0
    there = json.loads(capsys.readouterr().out)["roles"]
    assert exit_code("import", "lerobot", root, "--out", run) == 0
    capsys.readouterr()
    assert exit_code("info", run, "--json") == 0
    roles = json.loads(capsys.readouterr().out)["roles"]
    assert {*roles["state"]} == {*CONVENTIONS[name].state}
    assert {*roles["action"]} == {*CONVENTIONS[name].action}
    assert roles["grippers"] == there["grippers"]


def test_without_state_and_action_the_verdict_lists_unchecked_features(tmp_path: Path, capsys: Capture) -> None:
    source, root = write_convention(tmp_path / "all", UNKNOWN, frozen=True), tmp_path / "d"
    assert exit_code("dataset", "drop", source, "--episodes", "0", "--out", root) == 0  # it writes statistics
    capsys.readouterr()
    assert exit_code("check", root, "--no-images") == 0
    taken, verdict, *_ = capsys.readouterr().out.splitlines()
    assert "no state: --state COLUMN names it; no action: --action COLUMN names it" in taken
    assert "no role, so not looked at: measured, wanted" in taken
    assert verdict.startswith("good: ")
    assert "action_lag" in {each["check"] for each in diagnosis(capsys, root)["not_measured"]}
    named = diagnosis(capsys, root, *NAMED)
    assert named["taken"]["measured"] == "state"
    assert "action_lag" not in {each["check"] for each in named["not_measured"]}
    assert found_by(named, "frozen_state")


def test_info_shows_features_without_a_role_first_and_named_ones(tmp_path: Path, capsys: Capture) -> None:
    root = write_convention(tmp_path / "d", CONVENTIONS["agibot"])
    edit_json(root / "meta/info.json", lambda info: info["features"].update(odd={"dtype": "int64", "shape": [1]}))
    assert exit_code("info", root) == 0
    text = capsys.readouterr().out
    facts, table = text.split("\n\n")
    assert "observation.states.joint.position, observation.states.effector.position (4 elements)" in facts
    assert "gripper   effector" in facts
    rows = [line.split()[:2] for line in table.splitlines()[1:]]
    assert rows[0] == ["no", "role"]
    assert ["pose", "observation.states.end.position"] in rows
    assert ["velocity", "observation.states.joint.velocity"] in rows
    assert exit_code("info", root, "--json", "--state", "observation.states.end.position") == 0
    roles = json.loads(capsys.readouterr().out)["roles"]
    assert roles["state"] == ["observation.states.end.position"]
    assert roles["of"]["odd"] is None


@pytest.mark.parametrize(
    "call",
    [
        "info {d}",
        "check {d} --no-images",
        "view {d} --save {new}.rrd",
        "report {d} --out {new}.html",
        "import lerobot {d} --out {new}",
    ],
)
@pytest.mark.parametrize("flag", ["--state", "--action", "--gripper"])
def test_a_feature_that_does_not_exist_is_refused(call: str, flag: str, tmp_path: Path, capsys: Capture) -> None:
    root = write_convention(tmp_path / "d", UNKNOWN)
    words = call.format(d=root, new=tmp_path / "new").split()
    given = ("--state", "measured") if flag == "--gripper" else ()
    assert exit_code(*words, *given, flag, "mesured") == 2
    error = capsys.readouterr().err
    assert f"{flag}: unknown feature" in error
    assert "Did you mean 'measured'?" in error
    assert not list(tmp_path.glob("new*"))


def test_other_ways_to_name_a_role_wrongly(tmp_path: Path, capsys: Capture) -> None:
    root = write_convention(tmp_path / "d", UNKNOWN)
    assert exit_code("info", root, "--state", "measured", "--action", "measured") == 2
    assert "--action names 'measured', which --state already names" in capsys.readouterr().err
    assert exit_code("import", "bag.mcap", "--out", tmp_path / "run", *NAMED) == 2
    assert "only for datasets" in capsys.readouterr().err
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run", *NAMED, "--gripper", "3") == 2
    assert "An import takes whole features" in capsys.readouterr().err


def test_an_import_records_what_the_user_names(tmp_path: Path, capsys: Capture) -> None:
    root, run = write_convention(tmp_path / "d", UNKNOWN, frozen=True), tmp_path / "run"
    assert exit_code("import", "lerobot", root, "--out", run, *NAMED) == 0
    recording = run / "episodes/episode_000002.mcap"
    named = diagnosis(capsys, recording)
    assert found_by(named, "frozen_state")
    assert exit_code("info", recording) == 0
    assert "feature measured  state, 4 float32 (unnamed), units unknown" in capsys.readouterr().out
    assert exit_code("info", run) == 0
    assert "action    wanted (4 elements)" in capsys.readouterr().out
    assert exit_code("info", run, "--json", "--state", "wanted", "--action", "measured") == 0
    roles = json.loads(capsys.readouterr().out)["roles"]
    assert (roles["state"], roles["action"]) == (["wanted"], ["measured"])
    assert exit_code("import", "lerobot", root, "--out", run) == 2  # another import, since the roles differ
    assert "Another recording exists already" in capsys.readouterr().err


def test_playback_shows_the_state_first(tmp_path: Path) -> None:
    convention = Convention(CONVENTIONS["openpi"].state, CONVENTIONS["openpi"].action, others={"a_sensor": 2, "zoo": 1})
    root = write_convention(tmp_path / "d", convention)
    with find_episodes([root])[0].open() as episode:
        assert [*episode.curves] == ["state", "actions", "a_sensor", "zoo"]
        assert {name: role for name, role in episode.roles.of.items() if role} == {
            "state": "state",
            "actions": "action",
        }
    with find_episodes([root], named=NamedRoles(state=("zoo",), action=("state",)))[0].open() as episode:
        assert [*episode.curves][:2] == ["zoo", "state"]


def test_idle_frames_are_found_in_any_state(tmp_path: Path, capsys: Capture) -> None:
    root = write_convention(tmp_path / "d", CONVENTIONS["openpi droid"])
    assert exit_code("dataset", "trim", root, "--idle", "--dry-run") == 0
    assert exit_code("dataset", "trim", write_convention(tmp_path / "u", UNKNOWN), "--idle", "--dry-run") == 2
    assert "No state was found" in capsys.readouterr().err


EDITS = {"drop": "--episodes 0", "trim": "--head 2", "set-task": "--task wave"}


@pytest.mark.parametrize(
    ("name", "edit"), [(name, "trim") for name in CONVENTIONS] + [("unitree", "drop"), ("axes", "set-task")]
)
def test_edits_write_names_back_in_the_form_they_had(name: str, edit: str, tmp_path: Path) -> None:
    root = write_convention(tmp_path / "d", CONVENTIONS[name])
    edit_json(root / "meta/info.json", lambda info: next(iter(info["features"].values())).update(fps=30))
    assert exit_code("dataset", edit, root, *EDITS[edit].split(), "--out", tmp_path / "new") == 0
    before, after = (json.loads((path / "meta/info.json").read_text())["features"] for path in (root, tmp_path / "new"))
    assert json.dumps(before, sort_keys=True) == json.dumps(after, sort_keys=True)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 9) | st.floats(allow_nan=False) | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


@given(json_values, st.integers(1, 6))
def test_any_names_are_read_and_written_back_as_they_were(names: Any, count: int) -> None:
    found = read_names(names, count)
    assert found is None or (len(found) == count and all(isinstance(name, str) for name in found))
    feature = DatasetFeature.from_json({"dtype": "float32", "shape": [count], "names": names})
    assert json.dumps(feature.to_json()["names"]) == json.dumps(names)
    assert len(feature.elements) == count


def vector(count: int) -> Column:
    """A vector of floats without names."""
    return Column("float32", tuple(map(str, range(count))))


def test_a_whole_state_wins_over_its_parts() -> None:
    columns = {
        "observation.state.joint_position": vector(7), "observation.state.gripper_position": vector(1),
        "observation.state": vector(8), "action.original": vector(7), "action": vector(7),
        "observation.state.cartesian_position": vector(6), "is_first": Column("bool"), "reward": vector(1),
        "language_instruction": Column("string"), "exterior_image_1_left": Column("image"), "scores": vector(2),
    }  # fmt: skip
    roles = find_roles(columns, NamedRoles())
    assert (roles.state, roles.action) == (("observation.state",), ("action",))
    assert dict(roles.of) == {
        "observation.state.joint_position": "sensor", "observation.state.gripper_position": "gripper",
        "observation.state": "state", "action.original": "command", "action": "action",
        "observation.state.cartesian_position": "pose", "is_first": "label", "reward": "label",
        "language_instruction": "label", "exterior_image_1_left": "camera", "scores": None,
    }  # fmt: skip


def test_the_simulators_object_poses_are_not_a_state() -> None:
    roles = find_roles({"observation.environment_state": vector(9), "action": vector(4)}, NamedRoles())
    assert roles.state == ()
    assert [*roles.notes()] == ["No state found, so nothing was judged by it; name it: --state FEATURE."]


def test_the_users_gripper_joins_the_state() -> None:
    columns = {"observation.state": vector(3), "jaw": vector(1), "action": vector(4)}
    roles = find_roles(columns, NamedRoles(gripper=("jaw",)))
    assert roles.state == ("observation.state", "jaw")
    assert roles.grippers().tolist() == [False, False, False, True]
    assert roles.in_state(roles.action) == [0, 1, 2, 3]
    with pytest.raises(ConfigError, match="is int64, not a vector"):
        find_roles({**columns, "counts": Column("int64", ("0",))}, NamedRoles(state=("counts",)))

"""Markers that split a bag: discarded takes are left out, and markers that the mapping does not list are an error."""

from __future__ import annotations

from pathlib import Path

import pytest
from support import bag_mappings, bags
from support.check import result_of
from support.commands import exit_code

from demorec.mcap import Recording

TOPIC = "/episode"
TAKES = [(0.2, "start"), (0.9, "stop"), (1.1, "start"), (1.8, "stop"), (2.0, "start"), (2.7, "success")]
"""Three episodes."""


def _import(tmp_path: Path, marks: list[tuple[float, str]], *, keys: str = "", more: str = "") -> int:
    notes = bags.in_order(bags.so101(3.0) + bags.texts(TOPIC, marks))
    bag = bags.write_rosbag2(notes, tmp_path / "bag")
    text = f'{bag_mappings.SO101}[episodes]\ncut = "marker"\ntopic = "{TOPIC}"\n{keys}\n{more}'
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    return exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run")


def _begins(run: Path) -> list[float]:
    """Start of each episode in seconds, to a twentieth."""
    found = []
    for path in sorted((run / "episodes").glob("*.mcap")):
        with Recording(path) as recording:
            found.append(round((int(recording.table().time_ns[0]) - bags.EPOCH_NS) / bags.NS * 20) / 20)
    return found


@pytest.mark.parametrize(
    ("marks", "kept", "left_out"),
    [
        (TAKES, [0.2, 1.1, 2.0], []),
        ([*TAKES, (1.9, "discard")], [0.2, 2.0], ["1.09 to 1.79"]),  # after its end
        ([*TAKES, (1.5, "discard")], [0.2, 2.0], ["1.09 to 1.49"]),  # during the episode; the later stop has no effect
        ([*TAKES, (2.8, "discard"), (0.5, "discard")], [1.1], ["0.19 to 0.49", "1.99 to 2.69"]),
        ([*TAKES, (0.1, "discard"), (0.95, "")], [0.2, 1.1, 2.0], []),  # outside of episodes, and an empty marker
    ],
)
def test_discarded_takes_are_not_imported(
    marks: list[tuple[float, str]],
    kept: list[float],
    left_out: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _import(tmp_path, marks) == 0
    told = capsys.readouterr().out
    assert _begins(tmp_path / "run") == kept
    lines = [line.strip() for line in told.splitlines() if "no episode" in line]
    assert lines == [f"no episode from {place} s: its marker is 'discard'" for place in left_out]
    dropped = f", {len(left_out)} dropped" if left_out else ""
    assert f"{len(kept)} episode{'s' * (len(kept) > 1)}, " in told
    assert f" frames{dropped}: " in told
    assert told.endswith("No findings.\n")
    assert result_of(tmp_path / "run", "import_dropped", "run").verdict == "good"  # nothing is missing


def test_an_unknown_marker_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _import(tmp_path, [*TAKES, (1.9, "abort"), (1.95, "abort"), (2.75, "redo\x1b[2J")]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "The mapping does not list these markers of /episode: 'abort', 'redo\\x1b[2J'; put each" in err
    assert "episodes.discard" in err
    assert "episodes.ignore" in err
    assert not list((tmp_path / "run").glob("episodes/*"))


@pytest.mark.parametrize(
    ("keys", "kept"),
    [
        ('discard = ["abort", "discard"]', [0.2, 2.0]),
        ('ignore = ["abort"]', [0.2, 1.1, 2.0]),
        ('failure = "abort"\ndiscard = ["abort"]', [0.2, 1.1, 2.0]),  # a verdict, not a discard
    ],
)
def test_the_advice_of_the_refusal_works(keys: str, kept: list[float], tmp_path: Path) -> None:
    assert _import(tmp_path, [*TAKES, (1.9, "abort")], keys=keys) == 0
    assert _begins(tmp_path / "run") == kept

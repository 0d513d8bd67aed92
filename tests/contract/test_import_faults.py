"""An import reports each fault of a bag; bags without a fault give no finding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import bag_mappings, bags
from support.bag_faults import ACTION, FAULTS, FRONT, STATE, hurt
from support.check import result_of

from demorec.extensions.imports.bag import open_bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.bag_findings import all_findings
from demorec.extensions.imports.import_run import import_bags
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.extensions.imports.rows import Timelines
from demorec.extensions.imports.streams import read_streams

MAPPING = bag_mappings.SO101.replace('field = "position"', 'field = "position"\nunit = "rad"', 1)


@pytest.fixture(scope="module")
def notes() -> bags.Notes:
    return bags.so101(2.0)


def _findings(bag: Path, tmp_path: Path, text: str = MAPPING) -> set[str]:
    mapping = read_mapping(bag_mappings.write_mapping(text, tmp_path / "robot.toml"))
    streams = read_streams(open_bag(bag), mapping)
    return {finding.kind for finding in all_findings(Timelines(streams, mapping))}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_is_named(name: str, notes: bags.Notes, tmp_path: Path) -> None:
    hurt_notes = hurt(notes, name)
    bag = bags.write_mcap(hurt_notes, tmp_path / "bag.mcap")
    assert bag.read_bytes() != bags.write_mcap(bags.in_order(notes), tmp_path / "whole.mcap").read_bytes()
    assert FAULTS[name].kind in _findings(bag, tmp_path)
    run = tmp_path / "run"
    if FAULTS[name].is_refused:
        with pytest.raises(BagError) as caught:
            import_bags([bag], tmp_path / "robot.toml", run)
        assert "\n" not in str(caught.value)
        assert str(caught.value).endswith(f": {bag}")
        assert not list(run.glob("episodes/*"))
    else:
        (report,) = import_bags([bag], tmp_path / "robot.toml", run).reports
        assert FAULTS[name].kind in {finding.kind for finding in report.findings}
        assert len(list(run.glob("episodes/*.mcap"))) == 1


def test_copies_are_counted_next_to_messages_without_a_time(notes: bags.Notes, tmp_path: Path) -> None:
    """Every third message is repeated, and the last header has no time; `copied_episodes` must not count it."""
    topic = "/follower/joint_states"
    twice = hurt(notes, "duplicated messages")
    last = max(note.log_ns for note in twice if note.topic == topic)
    unstamped = bags.changed(twice, topic, lambda k, note: replace(note, header_ns=0) if note.log_ns == last else note)
    bag = bags.write_mcap(unstamped, tmp_path / "bag.mcap")
    mapping = read_mapping(bag_mappings.write_mapping(MAPPING, tmp_path / "robot.toml"))
    found = {
        finding.kind: finding.text for finding in all_findings(Timelines(read_streams(open_bag(bag), mapping), mapping))
    }
    copies = len(twice) - len(notes)
    assert copies > 10
    assert f"{copies} messages have the time of another one, {copies} of them the same bytes" in found["duplicates"]
    assert "1 of " in found["unstamped"]


def test_a_truncated_bag_is_named(notes: bags.Notes, tmp_path: Path) -> None:
    bag = bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap", chunk_size=20_000)
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) * 3 // 4])
    assert "cut_off" in _findings(bag, tmp_path)


@pytest.mark.parametrize("seed", range(2))
def test_a_clean_bag_gives_no_finding(seed: int, tmp_path: Path) -> None:
    """Ordinary jitter, latency, a resting robot and a gripper that is commanded only on change are not faults."""
    seconds = 2.0 + 0.3 * seed
    notes = bags.so101(seconds)
    resting = bags.changed(
        notes, "/leader/joint_states", lambda k, note: bags.with_body(note, position=note.body["position"].round(1))
    )
    bag = bags.write_mcap(bags.in_order(resting if seed % 2 else notes), tmp_path / "bag.mcap")
    assert _findings(bag, tmp_path) == set()


def test_a_drawn_camera_at_rest_is_not_frozen(notes: bags.Notes, tmp_path: Path) -> None:
    """Rendered images have no noise: they repeat while everything rests, for two images as for six."""
    images = bags.of_topic(notes, FRONT)
    same = {11: 10, **dict.fromkeys(range(21, 26), 20)}
    drawn = bags.changed(notes, FRONT, lambda k, note: replace(note, body=images[same.get(k, k)].body))
    assert _findings(bags.write_mcap(bags.in_order(drawn), tmp_path / "bag.mcap"), tmp_path) == set()


@pytest.mark.parametrize(("rests", "count", "is_frozen"), [(True, 6, False), (False, 6, True), (True, 17, True)])
def test_a_drawn_camera_that_sees_a_robot_rest_once(
    notes: bags.Notes, rests: bool, count: int, is_frozen: bool, tmp_path: Path
) -> None:
    """Rendered images may repeat briefly. If they repeat for longer, or while the robot moves, the camera hangs."""
    images, states = bags.of_topic(notes, FRONT), bags.of_topic(notes, STATE)
    begin, end = (images[k].header_ns for k in (20, 20 + count))
    stands = min(states, key=lambda note: abs(note.header_ns - begin)).body["position"]

    def standing(k: int, note: bags.Note) -> bags.Note:
        if not (rests and begin - bags.NS // 20 <= note.header_ns <= end):
            return note
        return bags.with_body(note, position=stands + 1e-5 * (k % 3))

    hung = bags.changed(
        notes, FRONT, lambda k, note: replace(note, body=images[20].body) if 20 <= k < 20 + count else note
    )
    bag = bags.write_mcap(bags.in_order(bags.changed(hung, STATE, standing)), tmp_path / "bag.mcap")
    assert ("frozen" in _findings(bag, tmp_path)) == is_frozen


def test_images_that_come_unevenly_are_not_lost(notes: bags.Notes, tmp_path: Path) -> None:
    off_s = np.random.default_rng(4).normal(0, 0.012, 100).clip(-0.015, 0.015).tolist()
    uneven = bags.changed(
        notes, FRONT, lambda k, note: replace(note, header_ns=note.header_ns + round(off_s[k] * bags.NS))
    )
    assert _findings(bags.write_mcap(uneven, tmp_path / "bag.mcap"), tmp_path) == {"jitter"}


def test_headers_without_time_are_accepted_if_the_mapping_expects_them(notes: bags.Notes, tmp_path: Path) -> None:
    """As with JointTrajectory, where time 0 means "at once"."""
    unstamped = bags.changed(notes, ACTION, lambda k, note: replace(note, header_ns=0))
    bag = bags.write_mcap(unstamped, tmp_path / "bag.mcap")
    place = f'topic = "{ACTION}"'
    assert _findings(bag, tmp_path, MAPPING) == {"unstamped"}
    assert _findings(bag, tmp_path, MAPPING.replace(place, f'{place}\nstamp = "log"')) == set()


@pytest.mark.parametrize("kind", ["drops", "frozen", "nothing"])
def test_check_reads_the_report(kind: str, notes: bags.Notes, tmp_path: Path) -> None:
    """The bag itself has been deleted by then."""
    name = next((name for name in sorted(FAULTS) if FAULTS[name].kind == kind), "")
    bag = bags.write_mcap(hurt(notes, name) if name else bags.in_order(notes), tmp_path / "bag.mcap")
    mapping = bag_mappings.write_mapping(MAPPING, tmp_path / "robot.toml")
    import_bags([bag], mapping, tmp_path / "run")
    bag.unlink()
    found = result_of(tmp_path / "run", "import_findings", "run")
    assert found.verdict == ("look" if name else "good")
    assert (kind in found.message) == bool(name)
    assert result_of(tmp_path / "run", "import_dropped", "run").verdict == "good"


def test_dropped_episodes_are_reported(notes: bags.Notes, tmp_path: Path) -> None:
    bag = bags.write_mcap(hurt(notes, "a long pause"), tmp_path / "bag.mcap")
    cut = '[episodes]\ncut = "times"\ntimes_s = [[0.1, 0.6], [0.6, 1.3]]\n'
    text = MAPPING.replace("fps = 30", 'fps = 30\nwhen_old = "drop_episode"')
    text = text.replace("[cameras.front]", cut + "[cameras.front]")
    import_bags([bag], bag_mappings.write_mapping(text, tmp_path / "robot.toml"), tmp_path / "run")
    result = result_of(tmp_path / "run", "import_dropped", "run")
    assert (result.verdict, result.findings[0].value) == ("look", "1")
    assert "camera front" in result.message

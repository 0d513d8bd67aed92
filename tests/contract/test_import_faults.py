"""An import reports each fault of a bag; bags without a fault give no finding."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import bag_mappings, bags
from support.bag_faults import ACTION, FAULTS, FRONT, hurt
from support.check import result_of

from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.import_run import import_bags

MAPPING = bag_mappings.SO101.replace('field = "position"', 'field = "position"\nunit = "rad"', 1)


@pytest.fixture(scope="module")
def notes() -> bags.Notes:
    return bags.so101(2.0)


def _findings(bag: Path, tmp_path: Path, text: str = MAPPING) -> dict[str, str]:
    """Kind of each finding of an import -> its text."""
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    (report,) = import_bags([bag], mapping, tmp_path / "run").reports
    assert len(list((tmp_path / "run").glob("episodes/*.mcap"))) == 1
    return {finding.kind: finding.text for finding in report.findings}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_is_named(name: str, notes: bags.Notes, tmp_path: Path) -> None:
    hurt_notes = hurt(notes, name)
    bag = bags.write_mcap(hurt_notes, tmp_path / "bag.mcap")
    assert bag.read_bytes() != bags.write_mcap(bags.in_order(notes), tmp_path / "whole.mcap").read_bytes()
    if not FAULTS[name].is_refused:
        assert FAULTS[name].kind in _findings(bag, tmp_path)
        return
    with pytest.raises(BagError) as caught:
        _findings(bag, tmp_path)
    assert "\n" not in str(caught.value)
    assert FAULTS[name].kind in str(caught.value)
    assert str(caught.value).endswith(f": {bag}")
    assert not list((tmp_path / "run").glob("episodes/*"))


def test_a_truncated_bag_is_named(notes: bags.Notes, tmp_path: Path) -> None:
    bag = bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap", chunk_size=20_000)
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) * 3 // 4])
    assert "cut_off" in _findings(bag, tmp_path)


def test_a_clean_bag_gives_no_finding(notes: bags.Notes, tmp_path: Path) -> None:
    """Ordinary jitter, latency, a resting robot and a gripper that is commanded only on change are not faults."""
    resting = bags.changed(
        notes, "/leader/joint_states", lambda k, note: bags.with_body(note, position=note.body["position"].round(1))
    )
    bag = bags.write_mcap(bags.in_order(resting), tmp_path / "bag.mcap")
    assert _findings(bag, tmp_path) == {}


def test_images_that_come_unevenly_are_not_lost(notes: bags.Notes, tmp_path: Path) -> None:
    off_s = np.random.default_rng(4).normal(0, 0.012, 100).clip(-0.015, 0.015).tolist()
    uneven = bags.changed(
        notes, FRONT, lambda k, note: replace(note, header_ns=note.header_ns + round(off_s[k] * bags.NS))
    )
    assert {"drops", "gap"}.isdisjoint(_findings(bags.write_mcap(uneven, tmp_path / "bag.mcap"), tmp_path))


def test_a_topic_without_times_in_its_headers_is_only_noted(notes: bags.Notes, tmp_path: Path) -> None:
    """As with JointTrajectory, where time 0 means "at once"."""
    unstamped = bags.changed(notes, ACTION, lambda k, note: replace(note, header_ns=0))
    bag = bags.write_mcap(unstamped, tmp_path / "bag.mcap")
    assert set(_findings(bag, tmp_path)) == {"note"}
    shutil.rmtree(tmp_path / "run")
    assert _findings(bag, tmp_path, MAPPING.replace("fps = 30", 'fps = 30\nstamp = "log"')) == {}


@pytest.mark.parametrize("kind", ["drops", "nothing"])
def test_check_reads_the_report(kind: str, notes: bags.Notes, tmp_path: Path) -> None:
    """The bag itself has been deleted by then."""
    name = next((name for name in sorted(FAULTS) if FAULTS[name].kind == kind), "")
    bag = bags.write_mcap(hurt(notes, name) if name else bags.in_order(notes), tmp_path / "bag.mcap")
    mapping = bag_mappings.write_mapping(MAPPING, tmp_path / "robot.toml")
    import_bags([bag], mapping, tmp_path / "run")
    bag.unlink()
    found = result_of(tmp_path / "run", "import_findings", "run")
    assert found.verdict == ("look" if name else "good")
    assert any(kind in finding.message for finding in found.findings) == bool(name)

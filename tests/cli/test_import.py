"""`demorec import` from the command line: messages, suggested mappings, rejected input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support import bag_mappings, bags
from support.commands import exit_code
from support.recording import write_episode

BAD: dict[str, tuple[int, str]] = {
    "no bag": (2, "No bag is given"),
    "a missing mapping": (2, "No mapping (demorec import ... --suggest > FILE writes one)"),
    "a misspelt format": (2, "No bag 'lerobt'. Did you mean 'lerobot'?"),
    "unknown encoding": (1, "the encoding 'cbor' is not supported"),
    "two types on a topic": (1, "has messages of several types"),
    "somebody's folder": (2, "choose another"),
    "a missing URDF": (2, "The URDF cannot be read"),
    "a folder without metadata": (1, "holds no metadata.yaml"),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_input_is_refused_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = BAD[name]
    notes = bags.in_order(bags.so101(0.4))
    text, run = bag_mappings.SO101, tmp_path / "run"
    if name == "two types on a topic":
        notes.append(
            bags.Note(topic="/leader/joint_states", type="std_msgs/msg/String", log_ns=notes[-1].log_ns, header_ns=0)
        )
    bag = (
        bags.write_mcap(notes, tmp_path / "bag.mcap") if name != "two types on a topic" else _two_types(notes, tmp_path)
    )
    match name:
        case "a missing URDF":
            text = text.replace('name = "so101"', 'name = "so101"\nurdf = "none.urdf"')
        case "somebody's folder":
            run.mkdir()
            (run / "thesis.tex").write_text("years")
        case "a folder without metadata":
            bag = tmp_path / "folder"
            bag.mkdir()
        case "unknown encoding":
            bag = _with_encoding(tmp_path, "cbor")
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    if name == "a missing mapping":
        mapping = tmp_path / "none.toml"
    words: list[str | Path] = [bag, "--mapping", mapping, "--out", run]
    others: dict[str, list[str | Path]] = {
        "no bag": words[1:],
        "a misspelt format": ["lerobt", bag, "--out", run],
    }
    words = others.get(name, words)
    before = sorted(path for path in tmp_path.rglob("*"))
    assert exit_code("import", *words) == code
    out, err = capsys.readouterr()
    assert told in err
    assert err.startswith("demorec import: ")
    assert err.count("\n") == 1
    assert out == ""
    assert sorted(tmp_path.rglob("*")) == before


def _with_encoding(tmp_path: Path, encoding: str) -> Path:
    from mcap.writer import Writer

    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic in ("/follower/joint_states", "/leader/joint_states", "/follower/cam_front/image_raw/compressed",
                      "/static_camera/cam_side/image_raw/compressed"):  # fmt: skip
            writer.add_message(writer.register_channel(topic, encoding, 0), 1, b"x", 1)
        writer.finish()
    return path


def _two_types(notes: bags.Notes, tmp_path: Path) -> Path:
    """Write a bag with two channels for one topic, which `mcap` keeps apart."""
    one = [note for note in notes if note.type != "std_msgs/msg/String"]
    other = [note for note in notes if note.type == "std_msgs/msg/String"]
    folder = tmp_path / "bag"
    bags.write_rosbag2(one, folder)
    bags.write_mcap([replace(note, body={"data": "x"}) for note in other], folder / "second.mcap")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("  - bag.mcap\n", "  - bag.mcap\n  - second.mcap\n", 1))
    assert "second.mcap" in (folder / "metadata.yaml").read_text()
    return folder


def test_a_recording_of_demorec_needs_no_import(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_episode(tmp_path / "a.mcap", num_frames=5)
    assert exit_code("import", "--suggest", path) == 0
    out, err = capsys.readouterr()
    assert err == f"Note: demorec made this recording, and reads it directly, without an import: {path}\n"
    assert out.startswith("# A mapping for a.mcap")

"""Bags with recorded services: events as rosbag2 stores them, including the definition of the service."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import Writer
from support import bag_mappings, bags
from support.commands import exit_code

from demorec.runs.run_file import load_any_run_file

EVENT = "std_srvs/srv/SetBool_Event"
DEFINITION = f"{'=' * 80}\nSRV: std_srvs/srv/SetBool\nbool data\n---\nbool success\nstring message\n"


def test_events_of_services_are_ignored(tmp_path: Path) -> None:
    arm = [note for note in bags.so101(2.0) if "joint_states" in note.topic]
    time_ns, data = arm[5].log_ns, b"\0\1\0\0" + bytes(64)
    event = bags.Note(topic="/record/_service_event", type=EVENT, log_ns=time_ns, header_ns=time_ns, data=data)
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for note in bags.in_order([*arm, event]):
            if note.topic not in channels:
                text = DEFINITION if note is event else bags._store().generate_msgdef(note.type, ros_version=2)[0]
                schema = writer.register_schema(note.type, "ros2msg", text.encode())
                channels[note.topic] = writer.register_channel(note.topic, "cdr", schema)
            data = note.data or bytes(bags._store().serialize_cdr(bags.ros_message(note), note.type))
            writer.add_message(channels[note.topic], note.log_ns, data, note.log_ns)
        writer.finish()
    text = bag_mappings.SO101.split("[cameras.front]")[0]
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    assert exit_code("import", "--suggest", tmp_path / "bag.mcap") == 0
    assert exit_code("import", tmp_path / "bag.mcap", "--mapping", mapping, "--out", tmp_path / "run") == 0
    (line,) = load_any_run_file(tmp_path / "run").attempts
    assert line.num_frames == 60

"""Episodes that calls of services cut: events as rosbag2 stores them, serialised by `rosbags` and written by `mcap`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support import bag_mappings, bags
from support.commands import exit_code

from demorec.mcap import Recording
from demorec.runs.run_file import load_any_run_file
from demorec.sources.fields import FieldError
from demorec.sources.ros_types import Budgets, ros_decoder
from demorec.sources.service_calls import CallReader

SEPARATOR = "=" * 80 + "\n"
DEFINITIONS = {
    "std_srvs/srv/SetBool_Event": ("bool data\n", "bool success\nstring message\n"),
    "std_srvs/srv/Trigger_Event": ("", "bool success\nstring message\n"),
}
STORE = get_typestore(Stores.ROS2_JAZZY)
for _event, (_request, _response) in DEFINITIONS.items():
    _name = _event.replace("/srv/", "/msg/").removesuffix("_Event")
    _short = _name.replace("/msg/", "/")
    STORE.register(get_types_from_msg(_request, f"{_name}_Request"))
    STORE.register(get_types_from_msg(_response, f"{_name}_Response"))
    STORE.register(
        get_types_from_msg(
            f"service_msgs/ServiceEventInfo info\n{_short}_Request[<=1] request\n{_short}_Response[<=1] response\n",
            f"{_name}_Event",
        )
    )
SECOND = bags.NS


def event(
    topic: str, kind: str, at_s: float, number: int, *, event_type: int, request: bool | None = None,
    success: bool | None = None,
) -> bags.Note:  # fmt: skip
    """An event of a call; `request` and `success` are what it says, None for nothing."""
    name = kind.replace("/srv/", "/msg/").removesuffix("_Event")
    types, time_ns = STORE.types, bags.EPOCH_NS + round(at_s * SECOND)
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // SECOND, nanosec=time_ns % SECOND)
    info = types["service_msgs/msg/ServiceEventInfo"](
        event_type=event_type, stamp=stamp, client_gid=np.arange(16, dtype=np.uint8), sequence_number=number
    )
    asked = types[f"{name}_Request"]
    requests = [] if request is None else [asked(data=request) if "SetBool" in kind else asked()]
    answers = [] if success is None else [types[f"{name}_Response"](success=success, message="")]
    message = types[f"{name}_Event"](info=info, request=requests, response=answers)
    data = bytes(STORE.serialize_cdr(message, f"{name}_Event"))
    return bags.Note(topic=topic, type=kind, log_ns=time_ns + 3_000_000, header_ns=time_ns, data=data)


def call(topic: str, kind: str, at_s: float, number: int, *, value: bool = True, success: bool = True) -> bags.Notes:
    """All four events of a call, the client's around the server's."""
    return [
        event(topic, kind, at_s, number, event_type=0, request=value),
        event(topic, kind, at_s + 0.002, number, event_type=1, request=value),
        event(topic, kind, at_s + 0.004, number, event_type=2, success=success),
        event(topic, kind, at_s + 0.006, number, event_type=3, success=success),
    ]


def write(notes: bags.Notes, path: Path) -> Path:
    """An MCAP file whose schemas are those of rosbag2: of a service's events it has the service's definition."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for note in bags.in_order(notes):
            if note.topic not in channels:
                if note.type in DEFINITIONS:
                    request, response = DEFINITIONS[note.type]
                    text = f"{SEPARATOR}SRV: {note.type.removesuffix('_Event')}\n{request}---\n{response}"
                else:
                    text, _ = STORE.generate_msgdef(note.type, ros_version=2)
                schema = writer.register_schema(note.type, "ros2msg", text.encode())
                channels[note.topic] = writer.register_channel(note.topic, "cdr", schema)
            data = note.data
            if data is None:
                data = bytes(bags._store().serialize_cdr(bags.ros_message(note), note.type))
            writer.add_message(channels[note.topic], note.log_ns, data, note.log_ns)
        writer.finish()
    return path


ARM = [note for note in bags.so101(3.0) if "joint_states" in note.topic]
MAPPING = "\n".join(line for line in bag_mappings.SO101.split("[cameras.front]")[0].splitlines())
ONE = '[episodes]\ncut = "service"\ntopic = "/record/_service_event"\n'
TWO = '[episodes]\ncut = "service"\nstart_topic = "/start/_service_event"\nstop_topic = "/stop/_service_event"\n'
SET_BOOL, TRIGGER = DEFINITIONS


def one_service() -> bags.Notes:
    """Recording set to true and false twice, and once refused in between."""
    topic = "/record/_service_event"
    notes = [*call(topic, SET_BOOL, 0.5, 1), *call(topic, SET_BOOL, 1.2, 2, value=False)]
    notes += call(topic, SET_BOOL, 1.4, 3, success=False)
    return [*notes, *call(topic, SET_BOOL, 1.8, 4), *call(topic, SET_BOOL, 2.6, 5, value=False)]


def two_services() -> bags.Notes:
    start, stop = "/start/_service_event", "/stop/_service_event"
    notes = [*call(start, TRIGGER, 0.5, 1), *call(stop, TRIGGER, 1.2, 1)]
    notes += call(stop, TRIGGER, 2.2, 2, success=False)
    return [*notes, *call(start, TRIGGER, 1.8, 3), *call(stop, TRIGGER, 2.6, 4)]


def imported(notes: bags.Notes, episodes: str, folder: Path) -> int:
    bag = write([*ARM, *notes], folder / "bag.mcap")
    mapping = bag_mappings.write_mapping(MAPPING + "\n" + episodes, folder / "robot.toml")
    return exit_code("import", bag, "--mapping", mapping, "--out", folder / "run")


@pytest.mark.parametrize(("notes", "episodes"), [(one_service(), ONE), (two_services(), TWO)], ids=["one", "two"])
def test_calls_cut_episodes(notes: bags.Notes, episodes: str, tmp_path: Path) -> None:
    assert imported(notes, episodes, tmp_path) == 0
    lines = load_any_run_file(tmp_path / "run").attempts
    assert len(lines) == 2
    for line, (begin, end) in zip(lines, ((0.5, 1.2), (1.8, 2.6)), strict=True):
        with Recording(tmp_path / "run" / line.file) as recording:
            times = (recording.columns().time_ns - bags.EPOCH_NS) / SECOND
        assert times[0] == pytest.approx(begin, abs=1e-6)
        assert end - 1 / 30 < times[-1] <= end


def test_times_of_recording_are_taken_where_the_mapping_says_so(tmp_path: Path) -> None:
    bag = write([*ARM, *one_service()], tmp_path / "bag.mcap")
    text = MAPPING.replace("fps = 30", 'fps = 30\nstamp = "log"') + "\n" + ONE
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    assert exit_code("import", bag, "--mapping", mapping, "--out", tmp_path / "run") == 0
    line = load_any_run_file(tmp_path / "run").attempts[0]
    with Recording(tmp_path / "run" / line.file) as recording:
        assert int(recording.columns().time_ns[0]) == bags.EPOCH_NS + 503_000_000


def test_a_suggestion_lists_the_events(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("import", "--suggest", write([*ARM, *one_service()], tmp_path / "bag.mcap")) == 0
    text = capsys.readouterr().out
    assert "/record/_service_event  std_srvs/srv/SetBool_Event" in text
    assert '# topic = "/record/_service_event"' in text


FAULTS: dict[str, tuple[bags.Notes, str, int, str]] = {
    "no requests": (
        [event("/record/_service_event", SET_BOOL, 0.5, 1, event_type=1)], ONE, 1, "introspection to 'contents'"
    ),
    "no call": (
        [*call("/stop/_service_event", TRIGGER, 0.5, 1), *call("/start/_service_event", TRIGGER, 1.2, 1)], TWO, 1,
        "is followed by one of",
    ),
    "no end": (
        call("/record/_service_event", SET_BOOL, 0.5, 1), ONE, 1,
        "No call of /record/_service_event with true (or 'start') in 'data' is followed by one with false",
    ),
    "cut off": (
        [replace(event("/record/_service_event", SET_BOOL, 0.5, 1, event_type=1, request=True), data=b"\0\1\0\0\1")],
        ONE, 1, "/record/_service_event cannot be read, since it ends within a value",
    ),
    "no such field": (one_service(), ONE + 'field = "dta"\n', 1, "Did you mean 'data'?"),
    "both": ([], ONE + 'start_topic = "/a"\nstop_topic = "/b"\n', 2, "either episodes.topic, or start_topic"),
    "half": ([], TWO.splitlines()[0] + '\ncut = "service"\nstart_topic = "/a"\n', 2, "either episodes.topic"),
    "both by half": ([], ONE + 'start_topic = "/a"\n', 2, "either episodes.topic, or start_topic"),
    "markers": (
        [], ONE.replace('"service"', '"marker"') + 'start_topic = "/a"\n', 2, 'for episodes.cut = "service" alone'
    ),
    "no events": ([], ONE.replace("/record/_service_event", "/leader/joint_states"), 1, "holds no events of a service"),
    "unknown type": (
        [event("/record/_service_event", SET_BOOL, 0.5, 1, event_type=9, request=True)], ONE, 1, "unknown type 9"
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {"event_type": [0]},
        {"sequence_number": "x"},
        {"sequence_number": float("inf")},
        {"client_gid": "text"},
        {"client_gid": 10**12},
        {"event_type": 2, "response": [{"success": np.zeros(2)}]},
    ],
    ids=str,
)
def test_other_messages_with_such_fields_are_no_events(changes: dict[str, object]) -> None:
    reader = CallReader(by_header=False)
    info: dict[str, object] = {"event_type": 0, "sequence_number": 1, "client_gid": b"0"}
    reader.add({"info": info}, 0)
    values = {"response": changes.pop("response", None)}
    with pytest.raises(FieldError, match="holds no events of a service"):
        reader.add({**values, "info": info | changes}, 0)


def test_events_without_their_definition_are_told() -> None:
    with pytest.raises(ValueError, match="it comes without the definition of the service std_srvs/srv/SetBool"):
        ros_decoder(SET_BOOL, "ros2msg", b"", is_cdr=True, budgets=Budgets())


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_bad_input_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    notes, episodes, code, told = FAULTS[name]
    assert imported(notes, episodes, tmp_path) == code
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1

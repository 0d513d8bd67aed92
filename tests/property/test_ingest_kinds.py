"""Kinds of other people's data, drawn at random: what an import cannot keep is refused or named, and the rest stays."""

from __future__ import annotations

import io
import json
import tempfile
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from support import bag_mappings, bags
from support.commands import exit_code
from support.drawn_datasets import ACTION, DRAWN, HEIGHT, PLAIN, REFERENCE, STATE, TOP, WIDTH, DrawnDataset, write_drawn
from support.export import recordings
from support.stored_episodes import seconds, stored_episodes

from demorec.mcap import Recording

FEW: dict[str, object] = {
    "deadline": None, "phases": [Phase.generate], "suppress_health_check": list(HealthCheck),
}  # fmt: skip
PIXELS = {
    "h264": ("yuv420p", "yuv422p", "yuv420p10le", "gray", "gray10le"),
    "hevc": ("yuv420p", "yuv420p10le", "yuv420p12le", "gray", "gray10le", "gray12le"),
    "png": ("rgb24", "gray", "gray16be"),
}
"""Codec -> pixel formats: colour, and single channels of 8 to 16 bits."""
MEASURED = ("gray10le", "gray12le", "gray16be")
"""Formats of depth or another measurement, which 8-bit colour would not hold."""
KINDS = st.sampled_from([(codec, pixels) for codec, formats in PIXELS.items() for pixels in formats])


def command(*words: object) -> tuple[int, str, str]:
    """Run a command; return exit code, output and errors."""
    out, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        code = exit_code(*words)
    return code, out.getvalue(), errors.getvalue()


@pytest.mark.slow
@settings(max_examples=8, **FEW)  # type: ignore[arg-type]
@given(kind=KINDS, version=st.sampled_from(["v2.1", "v3.0"]), gop=st.sampled_from([1, 3]))
def test_the_pixel_format_decides_what_a_video_of_a_dataset_holds(
    kind: tuple[str, str], version: str, gop: int
) -> None:
    codec, pixels = kind
    drawn = replace(PLAIN, is_variable=False, camera=codec, pixels=pixels, version=version, gop=gop)
    with tempfile.TemporaryDirectory() as folder:
        source, run = write_drawn(Path(folder) / "set", drawn), Path(folder) / "run"
        with av.open(str(next(source.rglob("*.mp4")))) as file:
            seen = file.streams.video[0].codec_context.pix_fmt
            assert seen == pixels or (codec == "h264" and "gray" in pixels)  # which libav takes for colour
        code, _, error = command("import", "lerobot", source, "--out", run)
        if pixels in MEASURED:
            assert (code, recordings(run)) == (2, [])
            assert f"The video of {TOP} holds {pixels}, which is depth or another measurement and not colour" in error
            told = f"The video of {TOP} holds {pixels}: depth or another measurement, not colour."
            assert told in command("check", source, "--only", "unreadable_episodes")[1]
            assert told in command("info", source)[1]
            assert command("dataset", "drop-features", source, TOP, "--out", Path(folder) / "rest")[0] == 0
            assert command("import", "lerobot", Path(folder) / "rest", "--out", run)[0] == 0
            return
        assert code == 0, error
        for path, length in zip(recordings(run), drawn.lengths, strict=True):
            with Recording(path) as recording:
                assert (recording.cameras, recording.num_frames) == (("top",), length)
                assert {image.shape for image in recording.images("top")} == {(HEIGHT, WIDTH, 3)}


@pytest.mark.slow
@settings(max_examples=6, **FEW)  # type: ignore[arg-type]
@given(kind=KINDS.filter(lambda kind: kind[0] != "png"), gop=st.sampled_from([1, 5]))
def test_the_pixel_format_decides_what_a_video_of_a_bag_holds(kind: tuple[str, str], gop: int) -> None:
    codec, pixels = kind
    notes = bags.trossen(1.0)
    deep = bags.of_topic(notes, "/cameras/cam_wrist/image")
    images = [bags.image(note.header_ns, 1) for note in deep]
    packets = bags.video(images, gop=gop, codec={"h264": "libx264", "hevc": "libx265"}[codec], pixels=pixels)
    name = {"h264": "h264", "hevc": "h265"}[codec]
    body = iter([{"format": name, "data": packet} for packet in packets])
    notes = [replace(note, body=next(body)) if note.topic == deep[0].topic else note for note in bags.in_order(notes)]
    with tempfile.TemporaryDirectory() as folder:
        bag, run = bags.write_trossen(notes, Path(folder) / "bag.mcap"), Path(folder) / "run"
        mapping = bag_mappings.write_mapping(bag_mappings.TROSSEN, Path(folder) / "robot.toml")
        code, _, error = command("import", bag, "--mapping", mapping, "--out", run)
        suggestion = command("import", bag, "--suggest")[1]
        is_mapped = f'[cameras.wrist]\ntopic = "{deep[0].topic}"' in suggestion
        if pixels in MEASURED:
            assert (code, recordings(run), is_mapped) == (1, [], False)
            assert f"holds {pixels}, which is depth or another measurement" in error
            assert f"holds {pixels}, which is depth or another measurement" in suggestion
            return
        assert (code, is_mapped) == (0, True), error
        with Recording(recordings(run)[0]) as recording:
            assert set(recording.cameras) == {"high", "wrist"}


@pytest.mark.slow
@settings(max_examples=8, **FEW)  # type: ignore[arg-type]
@given(
    rate=st.floats(10, 50),
    factor=st.floats(0.25, 4),
    command_rate=st.sampled_from([None, 0.5, 1.0, 2.0]),
    start_s=st.sampled_from([0.0, 12.5, 1e9]),
    jitter=st.sampled_from([0.0, 0.1]),
    seed=st.integers(0, 99),
)
def test_a_bag_with_simulated_time_loses_no_message_in_silence(
    rate: float, factor: float, command_rate: float | None, start_s: float, jitter: float, seed: int
) -> None:
    """`rate` messages a second by the log; the headers run `factor` times as fast, `command_rate` times as often."""
    topics = {"/joint_states": rate} | ({} if command_rate is None else {"/joint_command": rate * command_rate})
    notes = []
    for topic, topic_rate in topics.items():
        for note in bags.joints(topic, ("a", "b"), bags.times(topic_rate, 6.0, jitter=jitter, seed=seed)):
            header_ns = round((note.header_ns - bags.EPOCH_NS) * factor + start_s * bags.NS)
            notes.append(replace(note, header_ns=max(header_ns, 0)))
    with tempfile.TemporaryDirectory() as folder:
        bag, run = bags.write_rosbag2(bags.in_order(notes), Path(folder) / "wave_1"), Path(folder) / "run"
        suggestion = command("import", bag, "--suggest")[1]
        fps = tomllib.loads(suggestion)["clock"]["fps"]
        assert fps >= 0.98 * min(topics.values()) / factor - 0.5  # a whole number
        mapping = bag_mappings.write_mapping(suggestion, Path(folder) / "robot.toml")
        code, _, error = command("import", bag, "--mapping", mapping, "--out", run)
        assert code == 0, error
        with Recording(recordings(run)[0]) as recording:
            stamps = recording.table().stamps
        streams = {
            stream["topic"]: stream for stream in json.loads((run / "import.json").read_text())["bags"][0]["streams"]
        }
        for feature, topic in (("observation.state", "/joint_states"), ("action", "/joint_command")):
            if topic not in topics:
                continue
            known = np.unique([note.header_ns for note in notes if note.topic == topic and note.header_ns > 0])
            used = np.unique(stamps[feature])
            assert set(used) <= set(known)
            inside = known[(known >= used[0]) & (known <= used[-1])]
            assert streams[topic]["unused"] == str(len(inside) - len(used))


@pytest.mark.slow
@settings(max_examples=12, **FEW)  # type: ignore[arg-type]
@given(drawn=DRAWN)
def test_an_import_keeps_numbers_times_names_and_images_of_a_dataset(drawn: DrawnDataset) -> None:
    """Columns that refer to tasks are left out by name, all other numbers stay bit by bit."""
    with tempfile.TemporaryDirectory() as folder:
        source, run = write_drawn(Path(folder) / "set", drawn), Path(folder) / "run"
        code, told, error = command("import", "lerobot", source, "--out", run)
        assert code == 0, error
        assert (f"{REFERENCE} is left out: it may refer to tasks by number" in told) == bool(drawn.reference)
        for path, before in zip(recordings(run), stored_episodes(source), strict=True):
            with Recording(path) as recording:
                table, info = recording.table(), recording.info
                cameras = recording.cameras
                images = list(recording.images("top")) if cameras else []
            names = {feature.name: feature.names for feature in info.features}
            for name in (STATE, ACTION):
                kept = np.array(before.columns[name]).astype(drawn.claimed)
                assert table.features[name].tobytes() == kept.tobytes()
                assert names[name] == (tuple("abc") if drawn.names else ("0", "1", "2"))
            assert REFERENCE not in names
            assert info.instruction == before.tasks[0]
            frames = np.arange(len(before.tasks)) / drawn.fps
            times = frames if "timestamp" in drawn.missing or drawn.clock == "grid" else seconds(before)
            assert np.abs((table.time_ns - table.time_ns[0]) / 1e9 - (times - times[0])).max() <= 1e-7
            assert cameras == (("top",) if drawn.camera else ())
            assert len(images) >= len(before.tasks) * bool(drawn.camera)

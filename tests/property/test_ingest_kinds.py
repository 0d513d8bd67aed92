"""Kinds of other people's data, drawn at random: what an import cannot keep is refused or named, and the rest stays."""

from __future__ import annotations

import io
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
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
@given(kind=KINDS, version=st.sampled_from(["v2.1", "v3.0"]), gop=st.sampled_from([1, 3]), is_fragmented=st.booleans())
def test_the_pixel_format_decides_what_a_video_of_a_dataset_holds(
    kind: tuple[str, str], version: str, gop: int, is_fragmented: bool
) -> None:
    codec, pixels = kind
    drawn = replace(
        PLAIN, is_variable=False, camera=codec, pixels=pixels, version=version, gop=gop, is_fragmented=is_fragmented
    )
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

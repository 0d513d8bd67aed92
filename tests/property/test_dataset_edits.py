"""Edits change nothing else: every column, file and packet before and after, by PyArrow and libav."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from support.check import edit_json
from support.commands import exit_code
from support.drawn_datasets import ACTION, DRAWN, ENCODERS, REFERENCE, STATE, DrawnDataset, like, write_drawn
from support.export import files_of
from support.stored_episodes import StoredEpisode, is_counted, same_values, seconds, stored_episodes, task_texts

NEW_TASK = "sweep the table"
Slice = tuple[int, int, int]
"""Episode, first frame and frame after the last one."""


def words_of(operation: str, source: Path, out: Path, drawn: DrawnDataset) -> list[str]:
    """Arguments of a command."""
    count = len(drawn.lengths)
    flags = {
        "select": ["--episodes", "1"],
        "drop": ["--episodes", "0"],
        "trim": ["--head", "1", "--tail", "1"],
        "trim end": ["--tail", "2"],
        "split": ["--shares", "a=0.5", "b=0.5"],
        "rename": [f"{ACTION}=act"],
        "drop-features": [ACTION],
        "set-task": ["--task", NEW_TASK, "--episodes", "0"],
        "reorder": ["--order", ",".join(map(str, reversed(range(count))))],
        "shuffle": ["--seed", "3"],
        "cut": ["--at", "0=2", "1=1,3"],
        "repair": [],
    }[operation]
    return ["dataset", operation.split()[0], str(source), *flags, "--out", str(out)]


def slices_of(operation: str, drawn: DrawnDataset) -> list[Slice]:
    """Source slice of each resulting episode; for shuffle and split in the source's order."""
    whole = [(number, 0, length) for number, length in enumerate(drawn.lengths)]
    if operation == "select":
        return whole[1:2]
    if operation == "drop":
        return whole[1:]
    if operation == "reorder":
        return whole[::-1]
    if operation == "cut":
        parts = [(0, 0, 2), (0, 2, drawn.lengths[0]), (1, 0, 1), (1, 1, 3), (1, 3, drawn.lengths[1])]
        return [*parts, *whole[2:]]
    if operation.startswith("trim"):
        head, tail = (1, 1) if operation == "trim" else (0, 2)
        return [(number, head, last - tail) for number, _, last in whole]
    return whole


OPERATIONS = (
    "select", "drop", "trim", "trim end", "split", "rename", "drop-features", "set-task", "reorder", "shuffle", "cut",
    "repair",
)  # fmt: skip


def compare(before: StoredEpisode, after: StoredEpisode, part: Slice, operation: str, drawn: DrawnDataset) -> None:
    """Check that an episode of the result is a slice of a source episode, except for the requested change."""
    number, first, last = part
    expected = before.cut(first, last)
    if operation == "rename":
        expected.columns["act"] = expected.columns.pop(ACTION)
        expected.types["act"] = expected.types.pop(ACTION)
    if operation == "drop-features":
        del expected.columns[ACTION]
    if operation == "set-task" and number == 0:
        expected = StoredEpisode(**{**vars(expected), "tasks": [NEW_TASK] * (last - first)})
    for name, values in expected.columns.items():
        if name.startswith("extra") and isinstance(values[0], list):  # a list of one is the scalar that it holds
            expected.columns[name] = [value for (value,) in values]
        elif isinstance(values[0], bytes):  # images become structs, as LeRobot writes them
            expected.columns[name] = [{"bytes": value, "path": None} for value in values]
            expected.types[name] = after.types[name]
    assert same_values(expected, after, but=(REFERENCE, "is_pad")) == []
    times = seconds(after)
    # Repair takes measured times out where LeRobot looks for an image by them.
    is_renewed = operation == "repair" and drawn.clock != "grid" and drawn.camera in ENCODERS
    if "timestamp" in drawn.missing or is_renewed:
        stored = np.arange(last - first) / drawn.fps
    else:
        assert after.types["timestamp"] == before.types["timestamp"]
        stored = seconds(expected) - (seconds(expected)[0] if first else 0.0)
    if first and drawn.clock != "jitter":  # on the grid, whatever its start
        np.testing.assert_allclose(times, np.arange(last - first) / drawn.fps, atol=1e-6)
    else:
        kind = np.float32 if after.types["timestamp"] == "float" else np.float64
        assert times.tolist() == stored.astype(kind).tolist()


def check_files(source: Path, out: Path, operation: str) -> None:
    """Check that features and unknown files are unchanged."""
    for name in ("meta/notes of ours.txt", "extra/deep/calibration.bin"):
        assert (out / name).read_bytes() == (source / name).read_bytes()
    old, new = (json.loads((root / "meta/info.json").read_text())["features"] for root in (source, out))
    renamed = {"act": ACTION} if operation == "rename" else {}
    for name, feature in new.items():
        was = old.get(renamed.get(name, name))
        if was is not None:
            assert (feature["shape"], feature["names"]) == (was["shape"], was["names"])


def check_references(source: Path, out: Path, before: StoredEpisode, after: StoredEpisode, part: Slice) -> None:
    """Check that task numbers refer to the same texts as before."""
    _, first, last = part
    old, new = task_texts(source), task_texts(out)
    was = [old[number] for number in before.columns[REFERENCE][first:last]]
    assert [new[number] for number in after.columns[REFERENCE]] == was


def found_slice(after: StoredEpisode, before: list[StoredEpisode], parts: list[Slice]) -> Slice:
    """Find the source slice of a resulting episode by the first value of its state."""
    key = after.columns[STATE][0][0]
    return next(part for part in parts if before[part[0]].columns[STATE][part[1]][0] == key)


@pytest.mark.slow
@pytest.mark.parametrize("operation", OPERATIONS)
@settings(max_examples=2, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(drawn=DRAWN)
def test_no_edit_changes_what_was_not_asked_for(operation: str, drawn: DrawnDataset) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source, out = write_drawn(Path(folder) / "set", drawn), Path(folder) / "new"
        if operation == "repair":  # which writes nothing if there is no fault
            edit_json(source / "meta/info.json", lambda info: info.update(total_frames=drawn.total + 7))
        untouched = files_of(source)
        before, parts = stored_episodes(source), slices_of(operation, drawn)
        assert exit_code(*words_of(operation, source, out, drawn)) == 0
        outs = [out / "a", out / "b"] if operation == "split" else [out]
        results = [stored_episodes(result) for result in outs]
        found = []
        for result, episodes in zip(outs, results, strict=True):
            assert is_counted(episodes)
            check_files(source, result, operation)
            for place, after in enumerate(episodes):
                is_mixed = operation in ("split", "shuffle")
                part = found_slice(after, before, parts) if is_mixed else parts[place]
                compare(before[part[0]], after, part, operation, drawn)
                if drawn.reference:
                    check_references(source, result, before[part[0]], after, part)
                found.append(part)
        assert sorted(found) == sorted(parts)
        assert files_of(source) == untouched


@pytest.mark.slow
@settings(max_examples=4, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(drawn=DRAWN)
def test_a_merge_changes_nothing_of_its_sources(drawn: DrawnDataset) -> None:
    with tempfile.TemporaryDirectory() as folder:
        kinds = (drawn, like(drawn))
        sources = [write_drawn(Path(folder) / str(seed), kind, seed) for seed, kind in enumerate(kinds)]
        out = Path(folder) / "new"
        assert exit_code("dataset", "merge", *sources, "--out", out) == 0
        episodes = stored_episodes(out)
        assert is_counted(episodes)
        for kind, source in zip(kinds, sources, strict=True):
            for number, before in enumerate(stored_episodes(source)):
                part = (number, 0, kind.lengths[number])
                compare(before, episodes[0], part, "merge", kind)
                if drawn.reference:
                    check_references(source, out, before, episodes.pop(0), part)
                else:
                    episodes.pop(0)
        assert not episodes


@pytest.mark.slow
@settings(max_examples=4, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(drawn=DRAWN)
def test_appending_changes_no_episode_and_no_file_of_rows_or_images(drawn: DrawnDataset) -> None:
    """To a dataset of format v3.0 whose features a run of another one has."""
    drawn = replace(
        drawn, stored="float32", claimed="float32", extra=(), reference="", missing=(), has_unlisted=False,
        clock="grid", camera=drawn.camera if drawn.camera in ("h264", "hevc", "av1") else "",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        first, second = (write_drawn(Path(folder) / str(seed), drawn, seed) for seed in range(2))
        base, run = Path(folder) / "base", Path(folder) / "run"
        order = ",".join(map(str, range(len(drawn.lengths))))
        assert exit_code("dataset", "reorder", first, "--order", order, "--out", base) == 0
        assert exit_code("import", "lerobot", second, "--out", run) == 0
        episodes, files = stored_episodes(base), files_of(base)
        assert exit_code("export", "lerobot", run, "--out", base, "--append", "--no-verify") == 0
        after = stored_episodes(base)
        assert is_counted(after)
        assert len(after) == 2 * len(drawn.lengths)
        for old, new in zip(episodes, after, strict=False):
            assert repr(old) == repr(new)
        for old, new in zip(stored_episodes(second), after[len(episodes) :], strict=True):
            # Packets of a run have their parameter sets again; tests/conformance/test_kept_video.py compares images.
            assert same_values(replace(old, packets={}), new) == []
        kept = {name: data for name, data in files.items() if name.startswith(("data/", "videos/", "extra/"))}
        assert {name: data for name, data in files_of(base).items() if name in kept} == kept

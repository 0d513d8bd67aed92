"""The lines of `demorec info` about collected episodes and their runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.table import aligned, size_in_words

if TYPE_CHECKING:
    from demorec.recording.collected.summary import CollectedCameraSummary, CollectedSummary, FeatureSummary
    from demorec.runs.collected import CollectedRun

SUCCESS_WORDS = {None: "unknown", True: "success", False: "failure"}


def collected_lines(summary: CollectedSummary) -> list[str]:
    """About one recording."""
    robot = f"{summary.robot}{' (URDF known)' if summary.has_urdf else ''}"
    facts = [
        ("recording", f"{summary.path} ({size_in_words(summary.bytes)}, collected, format {summary.format_version})"),
        ("instruction", summary.instruction),
        ("episode", str(summary.episode_index)),
        ("outcome", _outcome(summary)),
        (
            "length",
            f"{summary.frames} frames, {summary.seconds:.2f} s, {summary.rate:.2f} Hz (nominal {summary.fps} Hz)",
        ),
        ("robot", robot),
        ("origin", " ".join([summary.origin.kind, *(file.name for file in summary.origin.files)])),
        *((f"feature {feature.name}", ", ".join(_feature(feature))) for feature in summary.features),
        *((f"camera {camera.name}", ", ".join(_camera(camera))) for camera in summary.cameras),
        *((f"dropped {what}", str(count)) for what, count in summary.drops.items()),
        ("digest", summary.digest[:16]),
        ("made with", ", ".join(f"{name} {version}" for name, version in summary.versions.items()) or "unknown"),
    ]
    streams = [(stream.topic, str(stream.messages), stream.type) for stream in summary.streams]
    return [*aligned(facts), "", *aligned([("topic", "messages", "type"), *streams])]


def _outcome(summary: CollectedSummary) -> str:
    if summary.is_recovered:
        return "unknown: recovered after a crash"
    return SUCCESS_WORDS[summary.success] + (f": {summary.reason}" if summary.reason else "")


def _feature(feature: FeatureSummary) -> Iterator[str]:
    yield f"{len(feature.elements)} {feature.dtype}"
    yield f"at most {1000 * feature.oldest:.3g} ms old"
    if feature.source:
        yield feature.source


def _camera(camera: CollectedCameraSummary) -> Iterator[str]:
    video = camera.video
    yield f"{video.width}x{video.height} {video.codec}{' as it came' if camera.is_kept else ''}"
    yield f"{camera.pictures} pictures"
    yield f"at most {1000 * camera.oldest:.3g} ms old"
    if camera.frames_without:
        yield f"{camera.frames_without} frames without"
    if camera.source:
        yield camera.source


def collected_run_lines(path: Path, run: CollectedRun) -> list[str]:
    """About a run."""
    frames = sum(line.num_frames for line in run.episodes)
    counts = {word: sum(line.success is success for line in run.episodes) for success, word in SUCCESS_WORDS.items()}
    told = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    facts = [
        ("run", f"{path} (collected)"),
        ("robot", run.robot),
        ("episodes", f"{len(run.episodes)} ({told})"),
        ("frames", f"{frames} ({frames / run.fps:.1f} s at {run.fps} Hz)"),
        ("size", size_in_words(sum(line.num_bytes for line in run.episodes))),
        ("digest", run.digest),
    ]
    rows = [("episode", "outcome", "frames", "size", "file", "task")]
    rows += [
        (
            str(line.episode_index),
            SUCCESS_WORDS[line.success] + (f": {line.reason}" if line.reason else ""),
            str(line.num_frames),
            size_in_words(line.num_bytes),
            line.file,
            line.instruction,
        )
        for line in run.episodes
    ]
    return [*aligned(facts), "", *aligned(rows)]

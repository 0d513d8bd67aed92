"""Logging of episodes to Rerun recordings, in words, numbers and columns: one, or two overlaid below /a and /b."""

from __future__ import annotations

import re
from itertools import groupby

import numpy as np
import rerun as rr

from demorec.core.errors import ConfigError
from demorec.core.geometry import Array
from demorec.episode.episode import Outcome
from demorec.episode.scene import Rgba
from demorec.episode.simulated import simulation_facts
from demorec.view.bodies import log_bodies, log_robot
from demorec.view.cameras import log_cameras
from demorec.view.episode import FORCE_CURVES, Curves, Playback
from demorec.view.paths import Paths, indexes
from demorec.view.style import (
    ASKED,
    FORCE,
    MEASURED,
    SECOND,
    TARGET,
    Color,
    phase_colors,
    segment_colors,
    series_colors,
)

_HEADINGS = {"subtask": "Now", "motion": "Motion", "plan": "Plan", "memory": "So far"}
"""Kind of statement -> its heading, in the order of the page."""
_COLORS = {"gripper": MEASURED, "gripper target": TARGET, FORCE_CURVES: FORCE, "target": ASKED}
_WIDTHS = {"target": 0.7, "gripper target": 1.2}
_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_LEVEL_COLORS: dict[str, Color] = {"info": (200, 200, 200), "warning": (255, 200, 60), "error": (255, 80, 80)}


def log_episode(
    recording: rr.RecordingStream,
    episode: Playback,
    *,
    root: str = "",
    label: str = "",
    tint: Rgba | None = None,
) -> None:
    """Log a whole episode below `root`; `label` is a prefix of its curves' names, `tint` colours its robot.

    Raises:
        DemorecError: The source is damaged, or a model is neither installed nor recorded.
    """
    paths = Paths(root)
    recording.log(paths.world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log_robot(recording, paths, episode, tint)
    log_cameras(recording, paths, episode)
    log_curves(recording, paths, episode, label, is_second=tint is not None)
    if episode.scene is not None:
        log_bodies(recording, paths, episode, episode.scene, tint)
    log_ee_path(recording, paths, episode)
    log_phases(recording, paths, episode)
    log_events(recording, paths, episode)
    log_boxes(recording, paths, episode)
    log_words(recording, paths, episode)
    recording.log(paths.summary, rr.TextDocument(summary(episode), media_type="text/markdown"), static=True)


def new_recording(episode: Playback) -> rr.RecordingStream:
    """Create an empty Rerun recording with the episode's name and properties."""
    recording = rr.RecordingStream(application_id(episode), recording_id=f"{episode.name}-{episode.identity}")
    recording.send_recording_name(entry(episode))
    recording.send_property("episode", rr.AnyValues(**properties(episode)))
    return recording


def application_id(episode: Playback) -> str:
    """Group in the viewer's list: episodes of one group, task and set of cameras share a layout."""
    words = ["" if episode.scene is None else episode.info.simulated.task, *episode.cameras]
    return "-".join(re.sub(r"[^A-Za-z0-9_]+", "-", word).strip("-") for word in (episode.group, *words) if word)


def log_ee_path(recording: rr.RecordingStream, paths: Paths, episode: Playback) -> None:
    """Log the gripper's path, one piece per frame so that a view can show the past, coloured by phase."""
    if episode.num_frames < 2 or episode.motion.base_from_tcp is None:
        return
    points = episode.world_from_base.apply(episode.motion.base_from_tcp[:, :3])
    phases = episode.data.phases or ("",) * episode.num_frames
    colors = phase_colors(phases)
    recording.log(paths.ee_path, rr.LineStrips3D.from_fields(radii=[-2.0]), static=True)
    columns = rr.LineStrips3D.columns(
        strips=np.stack([points[:-1], points[1:]], axis=1), colors=[colors[name] for name in phases[1:]]
    )
    recording.send_columns(paths.ee_path, indexes(episode.time_ns[1:], episode.time_ns), columns)


def log_curves(
    recording: rr.RecordingStream,
    paths: Paths,
    episode: Playback,
    label: str = "",
    *,
    is_second: bool = False,
) -> None:
    """Log all plots; `label` is a prefix of the curves' names, a second episode has other colours."""
    for name, curves in episode.curves.items():
        entity = paths.curves(name)
        lines = rr.SeriesLines(
            names=_curve_names(name, curves, label, is_second=is_second),
            colors=_curve_colors(name, curves, is_second=is_second),
            widths=[0.7 if is_second and len(curves.names) > 1 else _WIDTHS.get(name, 2.0)] * len(curves.names),
        )
        recording.log(entity, lines, static=True)
        on_frame = np.isin(curves.time_ns, episode.time_ns)
        for chosen, frame_times in ((on_frame, episode.time_ns), (~on_frame, None)):
            if chosen.any():
                columns = rr.Scalars.columns(scalars=curves.values[chosen])
                recording.send_columns(entity, indexes(curves.time_ns[chosen], frame_times), columns)


def _curve_names(name: str, curves: Curves, label: str, *, is_second: bool) -> list[str]:
    """Name the curves for the legend: curves of one name share a line, since it has room for eight."""
    short = [curve.removeprefix("panda_") for curve in curves.names]
    if name == "target":
        short = ["target"] * len(short)
    elif is_second and len(short) > 1:
        return [label.strip()] * len(short)
    return [f"{label}{curve}" for curve in short]


def _curve_colors(name: str, curves: Curves, *, is_second: bool) -> list[Color]:
    count = len(curves.names)
    if is_second:
        return [SECOND if count == 1 else ASKED] * count
    return [_COLORS[name]] * count if name in _COLORS else series_colors(count)


def log_phases(recording: rr.RecordingStream, paths: Paths, episode: Playback) -> None:
    """Log the phases of the motion as states over time."""
    colors = phase_colors(episode.data.phases)
    if not colors or set(colors) == {""}:
        return
    recording.log(paths.phase, rr.StateConfiguration(values=list(colors), colors=list(colors.values())), static=True)
    starts = _phase_starts(episode)
    columns = rr.StateChange.columns(state=[episode.data.phases[i] for i in starts])
    recording.send_columns(paths.phase, indexes(episode.time_ns[starts], episode.time_ns), columns)


def _phase_starts(episode: Playback) -> list[int]:
    """Find the frames at which the phase changes."""
    return [i for i, name in enumerate(episode.data.phases) if i == 0 or name != episode.data.phases[i - 1]]


def log_events(recording: rr.RecordingStream, paths: Paths, episode: Playback) -> None:
    """Log phase changes and events, in order."""
    colors = phase_colors(episode.data.phases)
    rows: list[tuple[int, str, str, Color]] = [
        (int(episode.time_ns[i]), "INFO", episode.data.phases[i], colors[episode.data.phases[i]])
        for i in _phase_starts(episode)
        if episode.data.phases[i]
    ]
    rows += [
        (time, _LEVELS[event.level], event.message or event.name, _LEVEL_COLORS[event.level])
        for time, event in episode.data.events()
    ]
    if episode.data.outcome is not None and episode.num_frames:
        end = int(episode.time_ns[-1])
        level, color = ("INFO", (60, 230, 120)) if episode.data.outcome.success else ("ERROR", (255, 80, 80))
        rows.append((end, level, episode.verdict, color))
    if not rows:
        return
    rows.sort(key=lambda row: row[0])
    columns = rr.TextLog.columns(
        text=[row[2] for row in rows], level=[row[1] for row in rows], color=[row[3] for row in rows]
    )
    recording.send_columns(paths.events, indexes(np.array([row[0] for row in rows]), episode.time_ns), columns)


def log_words(recording: rr.RecordingStream, paths: Paths, episode: Playback) -> None:
    """Log the page of current statements, rewritten at each change."""
    holds: dict[str, str] = {}
    frames, pages = [], []
    shown = sorted((item for item in episode.statements if item[1] in _HEADINGS), key=lambda item: item[0])
    for frame, group in groupby(shown, key=lambda item: item[0]):
        holds |= {kind: text for _, kind, text in group}
        frames.append(frame)
        pages.append("\n\n".join(f"**{title}**\n\n{holds[kind]}" for kind, title in _HEADINGS.items() if kind in holds))
    if pages:
        columns = rr.TextDocument.columns(text=pages, media_type=["text/markdown"] * len(pages))
        recording.send_columns(paths.words, indexes(episode.time_ns[frames], episode.time_ns), columns)


def log_boxes(recording: rr.RecordingStream, paths: Paths, episode: Playback) -> None:
    """Log boxes around the bodies visible to each camera, frame by frame, named on hovering (names hide images)."""
    found = {camera: list(episode.data.boxes(camera)) for camera in episode.data.cameras}
    colors = segment_colors(sorted({name for boxes in found.values() for _, name, _ in boxes}))
    for camera, boxes in found.items():
        if not boxes:
            continue
        recording.log(paths.camera(camera, "/boxes"), rr.Boxes2D.from_fields(show_labels=False), static=True)
        columns = rr.Boxes2D.columns(
            half_sizes=[(width / 2, height / 2) for _, _, (_, _, width, height) in boxes],
            centers=[(x + width / 2, y + height / 2) for _, _, (x, y, width, height) in boxes],
            labels=[name for _, name, _ in boxes],
            colors=[colors[name] for _, name, _ in boxes],
        )
        lengths = np.bincount([frame for frame, _, _ in boxes], minlength=episode.num_frames)
        recording.send_columns(
            paths.camera(camera, "/boxes"), indexes(episode.time_ns, episode.time_ns), columns.partition(lengths)
        )


_OF_A_RUN = re.compile(r"episode_0*(?P<number>\d+)(?:\.attempt_(?P<attempt>\d+))?")


def entry(episode: Playback) -> str:
    """A few characters for the viewer's narrow list: "3 ok", "0.1 FAIL place" (the attempt after the dot)."""
    match, outcome = _OF_A_RUN.fullmatch(episode.name), episode.data.outcome
    name = episode.name if match is None else ".".join(part for part in match.groups() if part is not None)
    if outcome is None or outcome.success is None:
        return f"{name} ?"
    return f"{name} ok" if outcome.success else f"{name} FAIL {outcome.failure_phase}".rstrip()


def properties(episode: Playback) -> dict[str, str | int | float | bool]:
    """Collect the properties that the viewer lists next to the recording's name."""
    info, outcome = episode.info, episode.data.outcome
    values: dict[str, str | int | float | bool] = {
        "instruction": info.instruction,
        "outcome": episode.verdict,
        "seconds": round(episode.duration, 3),
        "frames": episode.num_frames,
        "episode": info.episode_index,
        "robot": info.robot_name,
        "source": episode.source,
    }
    if outcome is not None and outcome.success is not None:
        values["success"] = outcome.success
    if facts := simulation_facts(info):
        values |= {"task": facts["task"], "seed": facts["root_seed"], "attempt": info.attempt}
        values |= {} if outcome is None else {"retries": outcome.num_retries}
        values |= {"config_digest": facts["config_digest"]} if facts["config_digest"] else {}
    if origin := _origin(episode):
        values["origin"] = origin
    return values


def _origin(episode: Playback) -> str:
    """Describe the origin; "" for a generated episode."""
    origin = episode.info.origin
    return origin if isinstance(origin, str) else ", ".join([origin.kind, *(file.name for file in origin.files)])


def summary(episode: Playback) -> str:
    """Write Markdown: task, outcome and its checks, failed ones first."""
    info, facts = episode.info, simulation_facts(episode.info)
    about = [facts.get("task", info.robot_name), f"episode {info.episode_index}"]
    about += [f"seed {facts['root_seed']}"] if facts else []
    length = f"{episode.duration:.1f} s · {episode.num_frames} frames (nominal {info.fps} Hz)"
    origin, checks = _origin(episode), [] if episode.data.outcome is None else _checks(episode.data.outcome)
    parts = [f"**{info.instruction}**", " · ".join(about), length, f"Outcome: **{episode.verdict}**"]
    return "\n\n".join([*parts, *([f"Origin: {origin}"] if origin else []), *checks]) + "\n"


def _checks(outcome: Outcome) -> list[str]:
    """Write a table of the success conditions, failed ones first."""
    rows = ["| | check | value | limit |", "|---|---|---|---|"]
    for check in sorted(outcome.checks, key=lambda check: check.passed):
        mark = "✓" if check.passed else "**✗**"
        unit = f" {check.unit}" if check.unit else ""
        rows.append(f"| {mark} | {check.name} | {check.value:.3g}{unit} | {check.limit:.3g}{unit} |")
    return ["\n".join(rows)] if outcome.checks else []


_ORANGE = (1.0, 0.62, 0.25, 0.6)
"""Translucent, so that overlapping episodes do not hide each other."""
A, B = Paths("/a"), Paths("/b")
DIFFERENCES = "/differences"


def new_comparison(a: Playback, b: Playback) -> rr.RecordingStream:
    """Create an empty Rerun recording named after both."""
    recording = rr.RecordingStream("demorec-compare", recording_id=f"{a.identity}-{b.identity}")
    recording.send_recording_name(f"A {entry(a)}, B {entry(b)}")
    recording.send_property("a", rr.AnyValues(**properties(a)))
    recording.send_property("b", rr.AnyValues(**properties(b)))
    return recording


def log_comparison(recording: rr.RecordingStream, a: Playback, b: Playback) -> None:
    """Log both episodes and their distances.

    Raises:
        ConfigError: The robots differ, so that the episodes cannot be overlaid.
        DemorecError: A source is damaged.
    """
    if a.scene is None or b.scene is None:
        raise ConfigError(
            "Only simulated episodes can be compared: the poses of other robots are unknown. View them without "
            "--compare."
        )
    if [*a.motion.joint_position] != [*b.motion.joint_position]:
        raise ConfigError(
            f"The episodes have different robots, {a.info.robot_name} and {b.info.robot_name}: "
            "compare two of the same robot."
        )
    log_episode(recording, a, root=A.root, label="A ")
    log_episode(recording, b, root=B.root, label="B ", tint=_ORANGE)
    for name, curves in differences(a, b).items():
        entity = f"{DIFFERENCES}/{name}"
        recording.log(entity, rr.SeriesLines(names=list(curves.names), widths=[2.0] * len(curves.names)), static=True)
        times = indexes(curves.time_ns, a.time_ns)
        recording.send_columns(entity, times, rr.Scalars.columns(scalars=curves.values))


def differences(a: Playback, b: Playback) -> dict[str, Curves]:
    """Compute per common frame: distances of gripper and objects (mm), and the largest joint difference (rad)."""
    count = min(a.num_frames, b.num_frames)
    time_ns = a.time_ns[:count]
    first, second = (np.stack([*episode.motion.joint_position.values()])[:, :count] for episode in (a, b))
    joints = np.abs(first - second).max(axis=0, initial=0.0)
    assert a.motion.base_from_tcp is not None
    assert b.motion.base_from_tcp is not None
    names, columns = ["gripper"], [_distance(a.motion.base_from_tcp[:count], b.motion.base_from_tcp[:count])]
    for name, poses in a.motion.object_poses.items():
        if name in b.motion.object_poses:
            names.append(name)
            columns.append(_distance(poses[:count], b.motion.object_poses[name][:count]))
    return {
        "distance": Curves(time_ns=time_ns, values=1000 * np.stack(columns, axis=1), names=tuple(names)),
        "joints": Curves(time_ns=time_ns, values=joints[:, None], names=("largest joint difference",)),
    }


def _distance(a: Array, b: Array) -> Array:
    return np.asarray(np.sqrt(((a[:, :3] - b[:, :3]) ** 2).sum(axis=1)))

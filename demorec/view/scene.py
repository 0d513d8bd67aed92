"""One episode into one Rerun recording: everything that can be seen of it, as columns."""

from __future__ import annotations

import re
from itertools import groupby

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.episode.scene import Rgba
from demorec.view.bodies import log_bodies
from demorec.view.cameras import log_cameras
from demorec.view.episode import PlayedEpisode, Statements
from demorec.view.motion import log_curves, log_ee_path, log_events, log_phases
from demorec.view.paths import Paths
from demorec.view.robot import log_robot
from demorec.view.style import segment_colors
from demorec.view.summary import entry, properties, summary
from demorec.view.times import indexes

_HEADINGS = {"subtask": "Now", "motion": "Motion", "plan": "Plan", "memory": "So far"}
"""Kind of statement -> its heading, in the order of the page."""


def log_episode(
    recording: rr.RecordingStream,
    episode: PlayedEpisode,
    *,
    root: str = "",
    label: str = "",
    tint: Rgba | None = None,
) -> None:
    """Send all of an episode below `root`; `label` goes before the names of its curves, `tint` colours its robot.

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
    log_words(recording, paths, episode.statements, episode.time_ns)
    recording.log(paths.summary, rr.TextDocument(summary(episode), media_type="text/markdown"), static=True)


def new_recording(episode: PlayedEpisode) -> rr.RecordingStream:
    """An empty Rerun recording with the episode's name and properties."""
    recording = rr.RecordingStream(application_id(episode), recording_id=f"{episode.name}-{episode.identity}")
    recording.send_recording_name(entry(episode))
    recording.send_property("episode", rr.AnyValues(**properties(episode)))
    return recording


def application_id(episode: PlayedEpisode) -> str:
    """The group in the viewer's list: episodes of one group, task and set of cameras share a layout."""
    words = ["" if episode.simulated is None else episode.simulated.task, *episode.cameras]
    return "-".join(re.sub(r"[^A-Za-z0-9_]+", "-", word).strip("-") for word in (episode.group, *words) if word)


def log_words(
    recording: rr.RecordingStream, paths: Paths, statements: Statements, frames_ns: NDArray[np.int64]
) -> None:
    """The page of what holds, anew whenever something changes; `frames_ns` (T,) are the times of all frames."""
    holds: dict[str, str] = {}
    times, pages = [], []
    told = sorted((item for item in statements if item[1] in _HEADINGS), key=lambda item: item[0])
    for time_ns, group in groupby(told, key=lambda item: item[0]):
        holds |= {kind: text for _, kind, text in group}
        times.append(time_ns)
        pages.append("\n\n".join(f"**{title}**\n\n{holds[kind]}" for kind, title in _HEADINGS.items() if kind in holds))
    if pages:
        columns = rr.TextDocument.columns(text=pages, media_type=["text/markdown"] * len(pages))
        recording.send_columns(paths.words, indexes(np.array(times, dtype=np.int64), frames_ns), columns)


def log_boxes(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """Boxes around what each camera sees, frame by frame; their names, which would hide small pictures, on pointing."""
    names = sorted({name for frames in episode.boxes.values() for seen in frames.values() for name, _ in seen})
    colors = segment_colors(names)
    for camera, frames in episode.boxes.items():
        seen = [frames.get(frame, ()) for frame in range(episode.num_frames)]
        flat = [item for items in seen for item in items]
        if not flat:
            continue
        recording.log(paths.camera(camera, "/boxes"), rr.Boxes2D.from_fields(show_labels=False), static=True)
        columns = rr.Boxes2D.columns(
            half_sizes=[(width / 2, height / 2) for _, (_, _, width, height) in flat],
            centers=[(x + width / 2, y + height / 2) for _, (x, y, width, height) in flat],
            labels=[name for name, _ in flat],
            colors=[colors[name] for name, _ in flat],
        )
        lengths = [len(items) for items in seen]
        recording.send_columns(
            paths.camera(camera, "/boxes"), indexes(episode.time_ns, episode.time_ns), columns.partition(lengths)
        )

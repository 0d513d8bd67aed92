"""One episode into one Rerun recording: everything that can be seen of it, as columns."""

from __future__ import annotations

import re

import rerun as rr

from demorec.playback.bodies import log_bodies
from demorec.playback.cameras import log_cameras
from demorec.playback.episode import PlayedCollected, PlayedEpisode
from demorec.playback.motion import log_curves, log_ee_path, log_events, log_phases
from demorec.playback.paths import Paths
from demorec.playback.robot import log_robot
from demorec.playback.summary import entry, properties, summary
from demorec.playback.words import log_boxes, log_words
from demorec.scene.scene import Rgba


def log_episode(
    recording: rr.RecordingStream,
    episode: PlayedEpisode | PlayedCollected,
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
    if isinstance(episode, PlayedEpisode):
        log_bodies(recording, paths, episode, tint)
        log_ee_path(recording, paths, episode)
        log_phases(recording, paths, episode)
        log_events(recording, paths, episode)
        log_boxes(recording, paths, episode)
    log_words(recording, paths, episode.statements, episode.time_ns)
    recording.log(paths.summary, rr.TextDocument(summary(episode), media_type="text/markdown"), static=True)


def new_recording(episode: PlayedEpisode | PlayedCollected) -> rr.RecordingStream:
    """An empty Rerun recording with the episode's name and properties."""
    recording = rr.RecordingStream(application_id(episode), recording_id=f"{episode.name}-{episode.identity}")
    recording.send_recording_name(entry(episode))
    recording.send_property("episode", rr.AnyValues(**properties(episode)))
    return recording


def application_id(episode: PlayedEpisode | PlayedCollected) -> str:
    """The group in the viewer's list: episodes of one group, task and set of cameras share a layout."""
    if isinstance(episode, PlayedCollected):
        words = [camera.name for camera in episode.info.cameras]
    else:
        words = [episode.info.task, "-".join(camera.name for camera in episode.info.scene.cameras)]
    return "-".join(re.sub(r"[^A-Za-z0-9_]+", "-", word).strip("-") for word in (episode.group, *words) if word)

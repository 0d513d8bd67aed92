"""Two episodes over each other: below /a and /b of one Rerun recording, with the distance between them as curves."""

from __future__ import annotations

import numpy as np
import rerun as rr

from demorec.core.errors import ConfigError
from demorec.core.geometry import Array
from demorec.view.episode import Curves, PlayedEpisode
from demorec.view.paths import Paths
from demorec.view.scene import log_episode
from demorec.view.summary import entry, properties
from demorec.view.times import indexes

_ORANGE = (1.0, 0.62, 0.25, 0.6)
"""Translucent, so that an episode that lies exactly where the other one does hides nothing of it."""
A, B = Paths("/a"), Paths("/b")
DIFFERENCES = "/differences"


def new_comparison(a: PlayedEpisode, b: PlayedEpisode) -> rr.RecordingStream:
    """An empty Rerun recording named after both."""
    recording = rr.RecordingStream("demorec-compare", recording_id=f"{a.identity}-{b.identity}")
    recording.send_recording_name(f"A {entry(a)}, B {entry(b)}")
    recording.send_property("a", rr.AnyValues(**properties(a)))
    recording.send_property("b", rr.AnyValues(**properties(b)))
    return recording


def log_comparison(recording: rr.RecordingStream, a: PlayedEpisode, b: PlayedEpisode) -> None:
    """Send both episodes and how far they are apart.

    Raises:
        ConfigError: The robots differ, so that nothing can be laid over each other.
        DemorecError: A source is damaged.
    """
    if a.simulated is None or b.simulated is None:
        raise ConfigError(
            "Only simulated episodes can be laid over each other: of others nobody knows that their robots stand "
            "alike. View them without --compare."
        )
    if [*a.joint_position] != [*b.joint_position]:
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


def differences(a: PlayedEpisode, b: PlayedEpisode) -> dict[str, Curves]:
    """Frame by frame, as long as both last: the gripper's and the objects' distance (mm), the joints' largest (rad)."""
    count = min(a.num_frames, b.num_frames)
    time_ns = a.time_ns[:count]
    first, second = (np.stack([*episode.joint_position.values()])[:, :count] for episode in (a, b))
    joints = np.abs(first - second).max(axis=0, initial=0.0)
    assert a.base_from_tcp is not None
    assert b.base_from_tcp is not None
    names, columns = ["gripper"], [_distance(a.base_from_tcp[:count], b.base_from_tcp[:count])]
    for name in a.object_poses:
        if name in b.object_poses:
            names.append(name)
            columns.append(_distance(a.object_poses[name][:count], b.object_poses[name][:count]))
    return {
        "distance": Curves(time_ns=time_ns, values=1000 * np.stack(columns, axis=1), names=tuple(names)),
        "joints": Curves(time_ns=time_ns, values=joints[:, None], names=("largest joint difference",)),
    }


def _distance(a: Array, b: Array) -> Array:
    return np.asarray(np.sqrt(((a[:, :3] - b[:, :3]) ** 2).sum(axis=1)))

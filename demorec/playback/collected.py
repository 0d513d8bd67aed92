"""Collected episodes as playback sees them: every feature as a plot, every camera, the robot if its URDF is known."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import batched
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from demorec.errors import DemorecError, as_reason
from demorec.geometry import Pose
from demorec.playback.cameras import Distances, send_depth, send_video
from demorec.playback.episode import Curves, Statements, Video, VideoBatch
from demorec.playback.meshes import SurfaceMesh, skeleton_meshes, urdf_meshes
from demorec.playback.paths import Paths
from demorec.playback.robot import log_model
from demorec.playback.style import series_colors
from demorec.playback.times import SECONDS, indexes
from demorec.playback.words import log_words
from demorec.recording import CollectedRecording
from demorec.recording.collected.transforms import JointPositions
from demorec.scene.collected import NO_PICTURE, CollectedColumns, CollectedInfo, CollectedOutcome
from demorec.scene.urdf import Urdf

log = logging.getLogger(__name__)

_PICTURES_AT_ONCE = 256


@dataclass(frozen=True, kw_only=True, eq=False)
class PlayedCollected:
    """What is shown of a collected episode; attributes as of `PlayedEpisode`.

    Attributes:
        time_ns: (T,) of the frames, since the first one.
        joint_position: Joint of the URDF -> (T,) rad or m.
        curves: Feature -> its elements over time.
        videos: Camera -> coded pictures, each at the time of the first frame that holds it.
        depth: Depth camera -> reads (time, distances as they came) of each of its pictures.
        statements: As of `PlayedEpisode`: the subtasks that somebody said.
    """

    name: str
    group: str
    identity: str
    source: str
    info: CollectedInfo
    outcome: CollectedOutcome | None
    time_ns: NDArray[np.int64]
    joint_position: Mapping[str, NDArray[np.float64]]
    curves: Mapping[str, Curves]
    videos: Mapping[str, Video]
    depth: Mapping[str, Callable[[], Iterator[tuple[int, Distances]]]] = field(default_factory=dict)
    statements: Statements = ()

    @property
    def num_frames(self) -> int:
        """Length."""
        return len(self.time_ns)

    @property
    def verdict(self) -> str:
        """The outcome in a word or two."""
        if self.outcome is None or self.outcome.success is None:
            return "outcome unknown"
        return "success" if self.outcome.success else f"failure: {self.outcome.reason or 'no reason given'}"


@contextmanager
def open_collected(path: Path, *, group: str) -> Iterator[PlayedCollected]:
    """The episode of a recording; its pictures can be read until the context is left.

    Raises:
        RecordingError: It cannot be read.
    """
    with CollectedRecording(path) as recording:
        info, columns = recording.info, recording.columns()
        time_ns = columns.time_ns - (columns.time_ns[0] if columns.num_frames else 0)
        positions = JointPositions(info.features)
        values = positions.of(columns.features) if positions.joints else np.zeros((len(time_ns), 0))
        yield PlayedCollected(
            name=path.name.removesuffix(".mcap"),
            group=group,
            identity=hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16],
            source=path.name,
            info=info,
            outcome=recording.outcome,
            time_ns=time_ns,
            joint_position=dict(zip(positions.joints, values.T, strict=True)),
            curves={
                feature.name: Curves(
                    time_ns=time_ns, values=columns.features[feature.name].astype(np.float64), names=feature.names
                )
                for feature in info.features
            },
            videos={
                camera: Video(
                    codec=recording.video_settings(camera).codec,
                    batches=partial(_batches, recording, camera, _shown_at(columns, camera, time_ns)),
                )
                for camera in recording.cameras
                if len(columns.picture_stamps[camera])
            },
            depth={
                camera: partial(_distances, recording, camera, _shown_at(columns, camera, time_ns))
                for camera in recording.depth_cameras
                if len(columns.picture_stamps[camera])
            },
            statements=tuple((int(time_ns[frame]), "subtask", text) for frame, text in recording.subtasks),
        )


def _shown_at(columns: CollectedColumns, camera: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(P,) when each picture of a camera is shown: with the first frame that holds it, or the next one after it.

    Not at its own stamp, which may be of another clock.
    """
    frames = np.flatnonzero(columns.pictures[camera] != NO_PICTURE)
    numbers = np.maximum.accumulate(columns.pictures[camera][frames])
    count = len(columns.picture_stamps[camera])
    places = np.minimum(np.searchsorted(numbers, np.arange(count)), max(len(frames) - 1, 0))
    return time_ns[frames[places]] if len(frames) else np.zeros(count, dtype=np.int64)


def _batches(recording: CollectedRecording, camera: str, shown_at: NDArray[np.int64]) -> Iterator[VideoBatch]:
    for packets in batched(recording.packets(camera), _PICTURES_AT_ONCE):
        yield VideoBatch(
            time_ns=shown_at[[packet.frame_index for packet in packets]],
            samples=[packet.data for packet in packets],
            is_keyframe=np.array([packet.is_keyframe for packet in packets]),
        )


def _distances(
    recording: CollectedRecording, camera: str, shown_at: NDArray[np.int64]
) -> Iterator[tuple[int, Distances]]:
    return zip(shown_at.tolist(), recording.distances(camera), strict=True)


def new_collected_recording(episode: PlayedCollected) -> rr.RecordingStream:
    """An empty Rerun recording with the episode's name and properties."""
    info = episode.info
    recording = rr.RecordingStream(collected_application(episode), recording_id=f"{episode.name}-{episode.identity}")
    number = re.sub(r"^episode_0*(?=\d)", "", episode.name)
    success = None if episode.outcome is None else episode.outcome.success
    recording.send_recording_name(f"{number} {({None: '?', True: 'ok', False: 'FAIL'})[success]}")
    recording.send_property(
        "episode",
        rr.AnyValues(
            instruction=info.instruction,
            outcome=episode.verdict,
            frames=episode.num_frames,
            robot=info.robot,
            origin=info.origin.kind,
            source=episode.source,
        ),
    )
    return recording


def collected_application(episode: PlayedCollected) -> str:
    """The group in the viewer's list: episodes of one run share a layout."""
    words = (episode.group, *(camera.name for camera in episode.info.cameras))
    return "-".join(re.sub(r"[^A-Za-z0-9_]+", "-", word).strip("-") for word in words if word)


def log_collected(recording: rr.RecordingStream, episode: PlayedCollected) -> None:
    """Send all of an episode.

    Raises:
        DemorecError: The source is damaged.
    """
    paths, info = Paths(), episode.info
    recording.log(paths.world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if info.urdf:
        urdf = Urdf.parse(info.urdf)
        meshes = _meshes(info.urdf, urdf)
        log_model(recording, paths, urdf, meshes, episode.joint_position, base=Pose(), time_ns=episode.time_ns)
    for camera, video in episode.videos.items():
        send_video(recording, paths.camera(camera), episode.time_ns, video)
    for camera, pictures in episode.depth.items():
        send_depth(recording, paths.depth(camera), episode.time_ns, pictures())
    for name, curves in episode.curves.items():
        entity = paths.curves(name)
        colors = series_colors(len(curves.names))
        recording.log(entity, rr.SeriesLines(names=list(curves.names), colors=colors), static=True)
        columns = rr.Scalars.columns(scalars=curves.values)
        recording.send_columns(entity, indexes(curves.time_ns, episode.time_ns), columns)
    log_words(recording, paths, episode.statements, episode.time_ns)
    recording.log(paths.summary, rr.TextDocument(_summary(episode), media_type="text/markdown"), static=True)


def _meshes(text: str, urdf: Urdf) -> Mapping[str, SurfaceMesh]:
    """Link -> what it looks like; rods between the joints where the URDF names files that are not here."""
    try:
        return urdf_meshes(text, None)
    except (DemorecError, OSError, ValueError) as error:
        log.warning("The robot is drawn as rods between its joints, since %s.", as_reason(error))
        return skeleton_meshes(urdf)


def _summary(episode: PlayedCollected) -> str:
    info = episode.info
    seconds = float(episode.time_ns[-1]) / 1e9 if episode.num_frames else 0.0
    origin = ", ".join([info.origin.kind, *(file.name for file in info.origin.files)])
    lines = [
        f"**{info.instruction}**",
        f"{info.robot} · episode {info.episode_index}",
        f"{seconds:.1f} s · {episode.num_frames} frames (nominal {info.fps} Hz)",
        f"Outcome: **{episode.verdict}**",
        f"Origin: {origin}",
    ]
    return "\n\n".join(lines) + "\n"


def collected_layout(episode: PlayedCollected, *, is_alone: bool = False) -> rrb.Blueprint:
    """The robot, if it is known, beside the cameras; the features below."""
    paths = Paths()
    top: list[rrb.View | rrb.Container] = []
    if episode.info.urdf:
        top.append(rrb.Spatial3DView(origin="/", contents=[f"+ {paths.robot}/**"], name=episode.info.robot))
    top += [
        rrb.Spatial2DView(origin=paths.camera(camera), contents=["$origin"], name=camera) for camera in episode.videos
    ]
    top += [rrb.Spatial2DView(origin=paths.depth(camera), name=camera) for camera in episode.depth]
    plots = [
        rrb.TimeSeriesView(
            origin="/",
            contents=[paths.curves(name)],
            name=name,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        )
        for name in episode.curves
    ]
    pages = [rrb.TextDocumentView(origin=paths.words, name="in words")] if episode.statements else []
    pages.append(rrb.TextDocumentView(origin=paths.summary, name="episode"))
    # Without pictures above there is room for texts one below the other.
    texts: list[rrb.View | rrb.Container] = list(pages) if top else [rrb.Vertical(*pages)]
    bottom = rrb.Horizontal(*plots, *texts, column_shares=[1.6] * len(plots) + [1.0] * len(texts))
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*top), bottom, row_shares=[5.0, 3.0]) if top else bottom,
        rrb.TimePanel(state="collapsed", timeline=SECONDS, fps=float(episode.info.fps), loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed" if is_alone else "expanded"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )

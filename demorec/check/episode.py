"""A recording as the checks see it: everything is read once, when the first check asks for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Form, NotMeasured
from demorec.check.cells import ImageKind, correlation
from demorec.check.drawn import NOT_DRAWABLE, ImageComparison, compare, strays
from demorec.check.episode_drawn import DrawnEpisode, draw_episode, draw_full_size, drawable_world
from demorec.check.evidence import Motion, Motions, Named, motion_of_features, motion_of_simulated, quaternions
from demorec.check.films import Films, films_of_recording, likeness_of_films
from demorec.check.full_size import FullSize, compare_with_encoder, frames_to_compare, share_off, with_lead
from demorec.check.rows import LinkMatrices, matrices
from demorec.check.summary import ImageSummary, summarise
from demorec.check.topic_scan import TopicScan, scan_topics
from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.episode.camera_error import stated_error
from demorec.episode.episode import Columns, Event, Outcome, frame_time_ns
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import SceneCamera
from demorec.mcap import Recording, channels
from demorec.mcap.chunks import Block
from demorec.mcap.container import Container
from demorec.render.recorded import RecordedWorld
from demorec.robots.urdf import Urdf


class CheckedEpisode(ExitStack):
    """One recording, closed at the end of a `with`. Properties raise RecordingError where the file does not give them.

    Args:
        path: The recording.
        named_urdf: Text of the robot's description that the user names, for a recording that is not simulated; "" for
            none.
    """

    def __init__(self, path: Path, named_urdf: str = "") -> None:
        super().__init__()
        self.path, self._named_urdf = path, named_urdf
        self._images: dict[tuple[str, ImageKind], ImageSummary] = {}
        self._comparisons: dict[tuple[str, ImageKind], ImageComparison] = {}
        self._full_sizes: dict[str, FullSize] = {}
        self._bodies: dict[str, Array] = {}
        self._links: dict[tuple[LinkMatrices, str], Array] = {}
        self._shared: dict[Callable[[CheckedEpisode], object], object] = {}

    def __exit__(self, *error: Any) -> bool | None:
        """Free everything: parts that refer to the whole would keep its images until the next garbage collection."""
        result = super().__exit__(*error)
        vars(self).clear()
        return result

    def shared[T](self, compute: Callable[[CheckedEpisode], T]) -> T:
        """What a function makes of the episode, computed once for all checks that ask for it."""
        if compute not in self._shared:
            self._shared[compute] = compute(self)
        return cast(T, self._shared[compute])

    @cached_property
    def recording(self) -> Recording:
        """The open recording."""
        return self.enter_context(Recording(self.path))

    @cached_property
    def form(self) -> Form:
        """By whether there is a scene; one that cannot be opened counts as simulated."""
        with suppress(RecordingError):
            return "simulated" if self.info.simulation is not None else "external"
        return "simulated"

    @property
    def info(self) -> EpisodeInfo:
        """What was known before the first frame."""
        return self.recording.info

    @property
    def outcome(self) -> Outcome | None:
        """What was known after its last frame."""
        return self.recording.outcome

    @cached_property
    def columns(self) -> Columns:
        """All numbers."""
        return self.recording.columns()

    @property
    def num_frames(self) -> int:
        """T."""
        return self.recording.num_frames

    @cached_property
    def frame_times(self) -> NDArray[np.int64]:
        """(T,) ns: when each frame ought to be."""
        return np.array([frame_time_ns(t, self.info.fps) for t in range(self.num_frames)], dtype=np.int64)

    @cached_property
    def scan(self) -> dict[str, TopicScan]:
        """Every message of every topic, read once: every chunk's checksum is verified on the way."""
        return scan_topics(self.container, self.blocks)

    @cached_property
    def blocks(self) -> dict[str, Block]:
        """topic -> all its messages, but for images, which would be too large to be in memory together."""
        streams = channels.IMAGE_STREAMS
        images = {channels.camera_topic(camera.name, stream) for camera in self.cameras for stream in streams}
        return self.container.blocks([topic for topic in self.container.channels if topic not in images])

    def block(self, topic: str) -> Block:
        """All messages of a topic that is none of images; an empty one where there is no such topic."""
        nothing = np.zeros(0, dtype=np.int64)
        return self.blocks.get(topic, Block(content=b"", time_ns=nothing, starts=nothing, lengths=nothing))

    @cached_property
    def container(self) -> Container:
        """The file's messages and metadata as they are."""
        return self.enter_context(closing(Container(self.path)))

    @property
    def message_counts(self) -> dict[str, int]:
        """Topic -> messages that are there; every chunk's checksum is verified on the way."""
        if self.form == "simulated":
            return {topic: len(scan.time_ns) for topic, scan in self.scan.items()}
        return Counter(topic for topic, _, _ in self.container.messages(tuple(self.container.channels)))

    @property
    def num_words(self) -> int:
        """How many events and subtasks there are."""
        return len(self.events) + len(self.recording.subtasks)

    @cached_property
    def motions(self) -> Motions:
        """The one of its robot, if it has a state."""
        return Motions([self._motion] if self._motion is not None else [])

    @cached_property
    def _motion(self) -> Motion | None:
        if self.form == "external":
            info, c = self.info, self.columns
            return motion_of_features(c.features, info.features, info.fps, self._named_urdf or info.urdf, c.time_ns)
        return motion_of_simulated(self.info, self.columns, self.urdf) if self.num_frames else None

    def quaternions(self) -> Iterator[Named]:
        """All rotations."""
        c = self.columns
        if self.form == "external":
            yield from quaternions(c.features, {feature.name: feature.names for feature in self.info.features})
            return
        poses = {"EE": c.base_from_tcp, "action EE": c.action_base_from_tcp, "command EE": c.command_base_from_tcp}
        poses |= {f"object {name}": table for name, table in c.object_poses.items()}
        poses |= {f"camera {name}": table for name, table in c.world_from_camera.items()}
        yield from ((name, table[:, 3:]) for name, table in poses.items())

    @property
    def num_arm(self) -> int:
        """How many arm joints the robot has."""
        return len(self.info.robot.arm_joints)

    @cached_property
    def urdf(self) -> Urdf:
        """The robot's joint tree, from the URDF that the recording itself contains (already scaled)."""
        return Urdf.parse(self.description)

    @cached_property
    def description(self) -> str:
        """The recorded URDF of the robot."""
        return self.recording.description()

    @cached_property
    def events(self) -> tuple[tuple[int, Event], ...]:
        """(time_ns, event) in order of time, without changes of phase."""
        return tuple(self.recording.events())

    def kinematics(self, joint_position: Array) -> LinkMatrices:
        """Forward kinematics of (T, n_arm) or (T, n_joints) positions."""
        by_name = dict(zip(self.info.robot.joint_names, joint_position.T, strict=False))
        return LinkMatrices(self.urdf, by_name, len(joint_position))

    @cached_property
    def recorded_kinematics(self) -> LinkMatrices:
        """Forward kinematics of the recorded joints."""
        return self.kinematics(self.columns.joint_position)

    def base_from_link(self, link: str, kinematics: LinkMatrices | None = None) -> Array:
        """(T, 4, 4), by default of the recorded joints; RecordingError: unknown link."""
        try:
            return (kinematics or self.recorded_kinematics)[link]
        except KeyError as error:
            raise RecordingError(f"The recorded URDF has no link {link!r}: {self.path}") from error

    def hand_poses(self) -> Iterator[tuple[str, Array, Array]]:
        """(where, poses (T, 7), base_from_tcp (T, 4, 4) by the joints): observed, wanted and commanded."""
        c, link = self.columns, self.info.robot.tcp_link
        yield "observed", c.base_from_tcp, self.base_from_link(link)
        for name, poses, joints in (
            ("action", c.action_base_from_tcp, c.action_joint_target),
            ("command", c.command_base_from_tcp, c.command_joint_target),
        ):
            yield name, poses, self.base_from_link(link, self.kinematics(joints))

    @cached_property
    def world_from_base(self) -> Array:
        """(1, 4, 4)."""
        return self.info.scene.robot.world_from_base.matrix()[None]

    def world_from_link(self, link: str, kinematics: LinkMatrices | None = None) -> Array:
        """(T, 4, 4), by default of the recorded joints; RecordingError: unknown link."""
        of_robot = kinematics or self.recorded_kinematics
        if (of_robot, link) not in self._links:
            self._links[of_robot, link] = np.asarray(self.world_from_base @ self.base_from_link(link, of_robot))
        return self._links[of_robot, link]

    @cached_property
    def world_from_tcp(self) -> Array:
        """The same of the tool centre point."""
        return self.world_from_link(self.info.robot.tcp_link)

    def world_from_object(self, name: str) -> Array:
        """(T, 4, 4) of a body: as recorded, or of a fixed one as the scene says."""
        if name not in self._bodies:
            c = self.columns
            if name in c.object_poses or (body := self.info.scene.body(name)).movable:
                self._bodies[name] = matrices(c.object_poses[name])
            else:
                self._bodies[name] = np.broadcast_to(body.world_from_body.matrix(), (c.num_frames, 4, 4))
        return self._bodies[name]

    def is_carried(self, name: str, height: float) -> NDArray[np.bool_]:
        """(T,) whether a closed hand has a movable body so many metres above its start."""
        c, position = self.columns, self.columns.object_poses[name][:, :3]
        near = np.linalg.norm(position - self.world_from_tcp[:, :3, 3], axis=1) < 0.05
        is_closed = c.command_gripper < 0.5 * c.gripper_width
        return np.asarray(near & (position[:, 2] > position[0, 2] + height) & is_closed)

    @property
    def cameras(self) -> tuple[SceneCamera, ...]:
        """Of the scene."""
        return self.info.scene.cameras

    def kinds(self, camera: str) -> tuple[ImageKind, ...]:
        """Which images of a camera were recorded."""
        depth: tuple[ImageKind, ...] = ("depth",) if self.recording.has_depth(camera) else ()
        labels: tuple[ImageKind, ...] = ("labels",) if self.recording.has_segmentation(camera) else ()
        return ("color", *depth, *labels)

    @cached_property
    def keyframes(self) -> Mapping[str, NDArray[np.int64]]:
        """Camera -> frames whose colour images are decoded without others."""
        return {camera.name: self.recording.keyframes(camera.name) for camera in self.cameras}

    def images(self, camera: SceneCamera, kind: ImageKind = "color") -> ImageSummary:
        """What the checks need of a camera's decoded images; decoded once."""
        if (camera.name, kind) not in self._images:
            keep: Iterable[int] = ()
            # Of colours all but those of the most unusual keyframe, which decoding shows.
            with suppress(RecordingError):
                if kind != "color":
                    keep = self.sampled[camera.name].tolist()[::2]
                else:
                    keep = with_lead(frames_to_compare(self.keyframes[camera.name], self.num_frames)).tolist()
            self._images[camera.name, kind] = summarise(self.recording, camera, kind, set(keep))
        return self._images[camera.name, kind]

    @cached_property
    def films(self) -> Films:
        """Those of the cameras of a recording that demorec did not simulate: each image once, beside its frame."""
        return films_of_recording(self.recording, self.columns)

    def distances(self) -> Iterator[tuple[str, Iterator[NDArray[Any]]]]:
        """Of its depth cameras."""
        yield from ((camera, self.recording.distances(camera)) for camera in self.recording.depth_cameras)

    def likeness_of_cameras(self) -> Iterator[tuple[str, float]]:
        """(two cameras, in different places as far as these are known, correlation of their images)."""
        if self.form == "external":
            yield from likeness_of_films(self.films)
            return
        poses = self.columns.world_from_camera
        for camera, other in combinations(self.cameras, 2):
            first, second = self.images(camera).cells, self.images(other).cells
            count = min(len(first), len(second))
            is_near = np.abs(poses[camera.name] - poses[other.name]).max(initial=0.0) < 1e-3
            if first.shape[1:] == second.shape[1:] and count >= 2 and not is_near:
                yield f"{camera.name} and {other.name}", correlation(first[:count], second[:count])

    @cached_property
    def _world(self) -> RecordedWorld:
        """What is drawn; SceneError where a model is missing."""
        return drawable_world(self.info, self.columns)

    @cached_property
    def _drawn(self) -> DrawnEpisode | NotMeasured:
        """The images as the recorded numbers make them; each single one where some are coded without loss."""
        kinds = {camera.name: self.kinds(camera.name) for camera in self.cameras}
        is_exact = any(of_camera != ("color",) for of_camera in kinds.values())
        try:
            colors = {camera.name: self.images(camera).cells for camera in self.cameras}
            return draw_episode(self.info, self._world, kinds, colors, draw_each=is_exact)
        except NOT_DRAWABLE as error:
            return NotMeasured(why=f"the recording cannot be drawn here: {error}")

    def strays(self, camera: SceneCamera, kind: ImageKind) -> Array | NotMeasured:
        """(T,) share of the cells of depth or labels that are not what the recorded numbers make of them."""
        if isinstance(self._drawn, NotMeasured):
            return self._drawn
        seen = self.images(camera, kind).cells
        if not len(seen):
            return NotMeasured(why=f"camera {camera.name} has no image that can be read")
        is_turned = camera.name in self._drawn.shift
        return strays(seen, self._drawn.cells[camera.name, kind], kind, is_turned=is_turned)

    @cached_property
    def sampled(self) -> Mapping[str, NDArray[np.int64]]:
        """Camera -> frames that are compared at their full size."""
        found = {}
        for camera in self.cameras:
            detail = self.images(camera).detail
            found[camera.name] = frames_to_compare(self.keyframes[camera.name], len(detail), detail)
        return found

    @cached_property
    def _drawn_full_size(self) -> Mapping[tuple[str, ImageKind], Mapping[int, NDArray[Any]]] | NotMeasured:
        """(camera, kind) -> frame -> image, as it was before it was encoded."""
        kinds = {camera.name: self.kinds(camera.name) for camera in self.cameras}
        try:
            return draw_full_size(self._world, kinds, self.sampled)
        except NOT_DRAWABLE as error:
            return NotMeasured(why=f"the recording cannot be drawn here: {error}")

    def _full_size(self, camera: SceneCamera, kind: ImageKind) -> Mapping[int, NDArray[Any]] | NotMeasured:
        drawn = self._drawn_full_size
        if isinstance(drawn, NotMeasured):
            return drawn
        if stated_error(camera.name, self.info.behaviour) is None and f"calibration_{camera.name}_angle" in (
            self.info.behaviour
        ):
            return NotMeasured(why=f"how camera {camera.name} is turned off its recorded pose is not recorded exactly")
        return drawn[camera.name, kind]

    def full_size(self, camera: SceneCamera) -> FullSize | NotMeasured:
        """Some colour images of a camera at their full size, against what is drawn and encoded again."""
        renderer = self.info.config.get("renderer", "raster")
        if renderer != "raster":
            return NotMeasured(why=f"colours of the renderer {renderer!r} are others than those that are drawn here")
        if isinstance(drawn := self._full_size(camera, "color"), NotMeasured):
            return drawn
        frames = self.sampled[camera.name]
        if len(frames) < 2:
            return NotMeasured(why=f"camera {camera.name} has {len(frames)} images")
        if camera.name not in self._full_sizes:
            kept = self.images(camera).kept
            missing = [frame for frame in with_lead(frames).tolist() if frame not in kept]
            seen = {**kept, **dict(zip(missing, self.recording.images_at(camera.name, missing), strict=True))}
            settings = self.recording.video_settings(camera.name)
            self._full_sizes[camera.name] = compare_with_encoder(settings, frames, seen, drawn)
        return self._full_sizes[camera.name]

    def pixels_off(self, camera: SceneCamera, kind: ImageKind) -> tuple[Array, NDArray[np.intp]] | NotMeasured:
        """Shares (N,) of the pixels of depth or labels that are others than drawn, and the frames (N,)."""
        if isinstance(drawn := self._full_size(camera, kind), NotMeasured):
            return drawn
        kept = self.images(camera, kind).kept
        frames = np.array([frame for frame in sorted(kept) if frame in drawn], dtype=np.intp)
        return np.array([share_off(kept[frame], drawn[frame]) for frame in frames.tolist()]), frames

    def compared(self, camera: SceneCamera, kind: ImageKind = "color") -> ImageComparison | NotMeasured:
        """A camera's images against what the recorded numbers make of them."""
        renderer = self.info.config.get("renderer", "raster")
        if kind == "color" and renderer != "raster":
            return NotMeasured(why=f"colours of the renderer {renderer!r} are others than those that are drawn here")
        if isinstance(self._drawn, NotMeasured):
            return self._drawn
        seen = self.images(camera, kind).cells
        if len(seen) < 3:
            return NotMeasured(why=f"camera {camera.name} has {len(seen)} images")
        if (camera.name, kind) not in self._comparisons:
            compared = compare(seen, self._drawn.cells[camera.name, kind], self._drawn.frames)
            shift = compared.shift + self._drawn.shift.get(camera.name, 0.0)
            self._comparisons[camera.name, kind] = replace(compared, shift=shift)
        return self._comparisons[camera.name, kind]

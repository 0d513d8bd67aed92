"""Draw recorded states with other cameras, sizes, renderers or appearance, without physics.

A new recording keeps every number of the old one and names it as its origin. With the recording's own cameras and
appearance the images are equal before encoding, so that the encoded packets are bit-exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.core.files import make_folder
from demorec.core.geometry import Pose
from demorec.core.plain import digest, from_plain, to_json
from demorec.core.registry import nearest_match, split_name
from demorec.core.seeding import generator
from demorec.core.tables import CAMERAS, RENDERERS, camera_name
from demorec.episode.episode import Outcome, Trajectory
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Scene, SceneCamera
from demorec.episode.simulated import with_simulation
from demorec.episode.variation import Ranges, resolve, true_cameras
from demorec.extensions.remake.options import RerenderOptions
from demorec.mcap import EpisodeWriter, Recording, open_simulated
from demorec.mcap.frames import frames_of
from demorec.render import Renderer, RenderSetup
from demorec.render.painter import Painter, WarmRenderer
from demorec.robots.assets import allow_models
from demorec.sim.recorded_states import RecordedStates
from demorec.tasks.vary import vary_looks


@dataclass(frozen=True, kw_only=True)
class RerenderReport:
    """Result of rendering a recording again.

    Attributes:
        source: The recording.
        num_images: Number of images in the new recording.
        compared: Cameras whose encoded images were compared with the recorded ones, because they should not change.
        differing: Camera of these -> first frame whose packet differs.
        was_there: Whether an earlier call had drawn it.
    """

    source: Path
    num_images: int
    compared: tuple[str, ...] = ()
    differing: Mapping[str, int] = field(default_factory=dict)
    was_there: bool = False


@dataclass(frozen=True, kw_only=True)
class SceneView:
    """Cameras and scene for the images of an episode.

    Attributes:
        scene: Scene that is drawn and recorded, with the recorded camera poses.
        true_cameras: The same cameras with their true poses, without the calibration error of `--variation full`.
        true_from_recorded: Camera name -> that error.
    """

    scene: Scene
    true_cameras: tuple[SceneCamera, ...]
    true_from_recorded: Mapping[str, Pose] = field(default_factory=dict)


def recorded_view(info: EpisodeInfo) -> SceneView:
    """Return the view of a recording, whose extrinsics may have a deliberate error, like a real camera's."""
    cameras, errors = true_cameras(info.simulated.scene.cameras, info.simulated.behaviour)
    return SceneView(scene=info.simulated.scene, true_cameras=cameras, true_from_recorded=errors)


def new_view(info: EpisodeInfo, options: RerenderOptions, allowed: Sequence[str] = ()) -> SceneView:
    """The view for the options.

    Raises:
        ConfigError: An unknown camera, or an image size that cannot be encoded.
    """
    old = recorded_view(info)
    names = options.cameras or tuple(camera.name for camera in info.simulated.scene.cameras)
    if not names:
        raise ConfigError("The recording has no cameras: name some with --cameras.")
    if len(set(map(camera_name, names))) != len(names):
        raise ConfigError(f"A camera is named twice: {' '.join(names)}.")
    recorded = {camera.name: camera for camera in info.simulated.scene.cameras}
    true = {camera.name: camera for camera in old.true_cameras}
    width, height = _default_size(info, options)
    believed_cameras, true_cameras = [], []
    for name in names:
        if name in recorded:
            w, h = options.width or recorded[name].width, options.height or recorded[name].height
            believed, actual = (replace(c, width=w, height=h) for c in (recorded[name], true[name]))
        elif name in CAMERAS.rows or split_name(name) is not None:
            preset = CAMERAS.load(name, allowed)
            believed = actual = preset.camera(camera_name(name), info.simulated.robot, width=width, height=height)
        else:
            known = tuple(dict.fromkeys((*recorded, *CAMERAS.rows)))
            raise ConfigError(f"Unknown camera {name!r}.{nearest_match(name, known)} Allowed: {', '.join(known)}.")
        _check_size(believed)
        believed_cameras.append(believed)
        true_cameras.append(actual)
    scene = replace(info.simulated.scene, cameras=tuple(believed_cameras))
    if options.looks is not None:
        rng = generator(
            root_seed=options.looks, episode_index=info.episode_index, attempt=info.attempt, purpose="looks"
        )
        scene = vary_looks(scene, resolve("full", Ranges()), rng)
    kept = {name: error for name, error in old.true_from_recorded.items() if name in names}
    return SceneView(scene=scene, true_cameras=tuple(true_cameras), true_from_recorded=kept)


def view_behaviour(info: EpisodeInfo, view: SceneView) -> dict[str, float]:
    """The behaviour of an episode, without calibration errors for cameras without an error in the view."""
    off = {f"calibration_{name}" for name in view.true_from_recorded}
    return {
        name: value
        for name, value in info.simulated.behaviour.items()
        if not name.startswith("calibration_") or name.rpartition("_")[0] in off
    }


def _default_size(info: EpisodeInfo, options: RerenderOptions) -> tuple[int, int]:
    first = info.simulated.scene.cameras[0] if info.simulated.scene.cameras else None
    width = options.width or (first.width if first else int(info.simulated.config.get("width", 224)))
    height = options.height or (first.height if first else int(info.simulated.config.get("height", 224)))
    return width, height


def _check_size(camera: SceneCamera) -> None:
    for what, value in (("width", camera.width), ("height", camera.height)):
        if not 16 <= value <= 8192 or value % 2:
            raise ConfigError(f"The {what} of the camera {camera.name!r} is {value}: it must be even, 16 to 8192.")


def config_as[T](config: object, kind: type[T]) -> T:
    """Parse a recorded config, or a part of it; ConfigError if this version cannot read it."""
    try:
        return from_plain(config, kind)
    except ValueError as error:
        raise ConfigError(f"The recorded config does not fit this version ({error}).") from error


def view_painter(renderer: Renderer, view: SceneView, config: Mapping[str, Any]) -> Painter:
    """Painter of a view's scene with the image options of a recording's config.

    Args:
        renderer: An entered renderer.
        view: Cameras and scene.
        config: Options for depth, segmentation and antialiasing.
    """
    return Painter(
        renderer,
        view.true_cameras,
        true_from_recorded=view.true_from_recorded,
        depth=bool(config.get("depth", False)),
        segmentation=bool(config.get("segmentation", False)),
        antialias=bool(config.get("antialias", True)),
    )


def rerender(
    source: Path,
    out: Path,
    options: RerenderOptions,
    *,
    allowed: Sequence[str] = (),
    overwrite: bool = False,
    renderers: WarmRenderer | None = None,
) -> RerenderReport:
    """Draw a recording again, unless `out` is the result of the same earlier call.

    Args:
        source: The recording.
        out: File to create.
        options: Changes of the images.
        allowed: The user's own modules that may be imported if the recording or the options name them.
        overwrite: Whether `out` may be replaced; it is then drawn in any case.
        renderers: Provides a renderer that stays warm between recordings; None makes and frees one.

    Raises:
        RecordingError: The source is damaged or empty.
        ConfigError: The options are impossible, or another file exists at `out`.
        SceneError: A model file of the scene is missing or broken.
        RenderError: The renderer cannot draw the scene.
    """
    if out.resolve() == source.resolve():
        raise ConfigError(f"The new recording would replace its own source, choose another --out: {out}")
    allow_models(allowed)
    with open_simulated(source) as recording:
        info, trajectory = recording.info, recording.trajectory()
        if trajectory.num_frames == 0:
            raise RecordingError(f"The recording has no frames: {source}")
        view, config = new_view(info, options, allowed), {**info.simulated.config, **options.config}
        RENDERERS.check_name(str(config.get("renderer", "raster")))
        video = config_as(config.get("video", {}), VideoConfig)
        new_info = _drawn_info(recording, view, config)
        was_there = not overwrite and finished_outcome(out, new_info) == _outcome(recording)
        if not was_there:
            states = RecordedStates(info.simulated.robot, view.scene, trajectory)
            make_folder(out.parent)
            with (
                nullcontext(renderers) if renderers is not None else WarmRenderer() as warm,
                EpisodeWriter(out, new_info, video=video, overwrite=overwrite) as writer,
            ):
                renderer = warm.of(str(config.get("renderer", "raster")))
                _write_drawn(writer, recording, trajectory, view_painter(renderer, view, config), states)
                # Free the image buffers before the simulator poses the states of the next recording.
                renderer.setup(RenderSetup(bodies=(), cameras=()))
        compared = _compare(recording, out, options)
    return RerenderReport(
        source=source,
        num_images=trajectory.num_frames * len(view.scene.cameras),
        compared=tuple(compared),
        differing={name: frame for name, frame in compared.items() if frame is not None},
        was_there=was_there,
    )


def _drawn_info(recording: Recording, view: SceneView, config: Mapping[str, Any]) -> EpisodeInfo:
    info = recording.info
    return with_simulation(
        replace(info, origin=f"render of {recording.digest()[:16]}"),
        scene=view.scene,
        behaviour=view_behaviour(info, view),
        config=config,
        config_digest=digest(config),
    )


def _write_drawn(
    writer: EpisodeWriter, recording: Recording, trajectory: Trajectory, painter: Painter, states: RecordedStates
) -> None:
    """Write all frames of a recording with new images, and its outcome."""
    painter.setup(states)
    for frame in frames_of(trajectory, recording.events(), recording.joint_samples()):
        states.frame = frame.frame_index
        writer.write(replace(frame, images=painter.images()))
    writer.finish(_outcome(recording))


def finished_outcome(path: Path, info: EpisodeInfo) -> Outcome | None:
    """Return the outcome of a complete recording with the description that would be written now, if it exists.

    The description has the source's digest and everything that decides the images or the replay.
    """
    try:
        with open_simulated(path) as recording:
            if to_json(recording.info) != to_json(info):
                return None
            recording.digest()  # reads all of it and verifies the checksums
            return recording.outcome
    except RecordingError:
        return None


def _outcome(recording: Recording) -> Outcome:
    if recording.outcome is not None:
        return recording.outcome
    return Outcome(
        success=False,
        checks=(),
        failure_phase="recording",
        failure_reason="interrupted",
        num_frames=recording.num_frames,
    )


def _compare(recording: Recording, out: Path, options: RerenderOptions) -> dict[str, int | None]:
    """Compare the packets of unchanged cameras: equal images give equal packets.

    Returns:
        Camera -> first frame whose packet differs, or None.
    """
    found: dict[str, int | None] = {}
    if options.looks is not None:
        return found
    with open_simulated(out) as new:
        if recording.info.simulated.config.get("renderer") != new.info.simulated.config.get("renderer"):
            return found
        before = {camera.name: camera for camera in recording.info.simulated.scene.cameras}
        for camera in new.info.simulated.scene.cameras:
            name = camera.name
            if before.get(name) == camera and new.video_settings(name) == recording.video_settings(name):
                pairs = zip(recording.packets(name), new.packets(name), strict=True)
                found[name] = next((a.frame_index for a, b in pairs if a.data != b.data), None)
    return found

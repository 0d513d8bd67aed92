"""Conversion of one recording to one episode of a dataset: features, encoded images, statistics, sidecar row."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.extension import rows_of
from demorec.core.tables import EXTRA_FILES
from demorec.datasets.episode import DONE, REWARD, SCALARS, SUCCESS, ExportCamera, ExportEpisode
from demorec.datasets.lerobot.depth import depth_info, depth_video
from demorec.datasets.lerobot.language import COLUMNS, EpisodeLanguage, Statement, episode_language, language_arrays
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    LANGUAGE_FEATURE,
    DatasetFeature,
    DatasetInfo,
    video_info,
)
from demorec.datasets.lerobot.mp4 import EncodedVideo
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS, motor_features
from demorec.datasets.lerobot.sidecar import EpisodeRecord
from demorec.datasets.lerobot.stats import PixelHistogram, Statistics, colour_levels
from demorec.datasets.lerobot.writer import EpisodeData
from demorec.episode.episode import Table
from demorec.episode.features import ACTION, EE_POSE, STATE, VELOCITY
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import scene_of
from demorec.mcap import Recording, VideoSettings
from demorec.mcap.video import make_encoder
from demorec.robots.motors import Motors

LeRobotEpisode = ExportEpisode[ExportOptions]
NO_PLACE = (VELOCITY, EE_POSE, REWARD, DONE, SUCCESS)
"""Features that LeRobot does not record from a real arm."""
_TRANSCODED = VideoConfig(codec="h264", crf=18)
"""Encoding of images that cannot pass through."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedEpisode:
    """An episode in memory, ready to be written.

    Attributes:
        data: Rows, videos and row of the sidecar.
        traits: Properties that all episodes of the dataset share.
        info: Description of a dataset made from this episode.
        depth_left_out: Depth cameras that were not requested.
        transcoded: Cameras with transcoded images, and the reason.
        has_statements: Whether it has any language.
        meanings: Feature -> its origin or units in the recording.
        extra: Flag of requested files of extensions -> their data of the episode.
    """

    data: EpisodeData
    traits: Mapping[str, str]
    info: DatasetInfo
    depth_left_out: tuple[str, ...]
    transcoded: tuple[str, ...]
    has_statements: bool
    meanings: Mapping[str, str]
    extra: Mapping[str, Any]


def export_episode(recording: Recording, options: ExportOptions) -> LeRobotEpisode:
    """Select the frames, features and images of a recording for a dataset with these options. Raises ConfigError for
    options that the recording does not support, or a calibration that does not fit the arm's servos, and RecordingError
    if it is damaged.
    """
    if options.motor_units is None:
        return ExportEpisode(recording, options)
    name = recording.info.robot_name
    if scene_of(recording.info) is None or name not in IN_MOTOR_UNITS:
        raise ConfigError(
            f"Motor units exist for simulated episodes of {', '.join(IN_MOTOR_UNITS)}, not for those "
            f"of {name or 'an unnamed robot'}: leave out --motor-units: {recording.path}"
        )
    motors = IN_MOTOR_UNITS[name].motors(options.motor_units, options.calibration)
    info, read_table = _info_of_arm(recording, motors), partial(_motor_table, recording, motors)
    return ExportEpisode(recording, options, info=info, read_table=read_table)


def _info_of_arm(recording: Recording, motors: Motors) -> EpisodeInfo:
    simulation = recording.info.simulated
    return replace(
        recording.info,
        robot_name=motors.robot_type,
        urdf=recording.description(),
        features=motor_features(motors),
        origin=f"simulated: {simulation.task}, seed {simulation.root_seed}, configuration {simulation.config_digest}",
        simulation=None,
    )


def _motor_table(recording: Recording, motors: Motors) -> Table:
    trajectory, table = recording.trajectory(), recording.table()
    jaw = recording.info.simulated.robot.gripper.joint_position(trajectory.action_gripper)
    targets = np.concatenate([trajectory.action_joint_target, jaw], axis=1)
    values = {STATE: motors.values(trajectory.joint_position), ACTION: motors.values(targets)}
    return replace(table, features=values, stamps=dict.fromkeys(values, table.time_ns))


def prepare_episode(episode: LeRobotEpisode) -> ExportedEpisode:
    """Read an episode into memory. Raises ConfigError for files of extensions that need more, ExportError if it has no
    frames, or frames without images, and RecordingError if it is damaged.
    """
    options, recording, fps, columns = episode.options, episode.recording, episode.info.fps, episode.columns
    reasons = reasons_to_transcode(episode)
    videos = recorded_videos(episode, [camera for camera, reason in reasons.items() if not reason])
    pixels: dict[str, PixelHistogram | Statistics] = {}
    video_infos: dict[str, dict[str, Any]] = {}
    for camera in episode.cameras:
        key, settings = camera.feature, recording.video_settings(camera.name)
        if camera.is_depth:
            videos[key], pixels[key] = depth_video(episode.images(camera), fps=fps)
            video_infos[key] = depth_info((settings.width, settings.height), fps)
            continue
        if reasons[camera]:
            videos[key], settings = _transcoded_video(episode, camera)
        video_infos[key] = _video_info(settings)
        found = recording.pixel_statistics(camera.name)
        pixels[key] = PixelHistogram(counts=found.counts, level_values=colour_levels(), num_images=found.num_images)
    language = language_of(episode)
    language_columns = {} if options.language is None else language_arrays(language, episode.num_frames)
    data = EpisodeData(
        task=episode.info.instruction,
        columns={**columns, **language_columns},
        videos=videos,
        video_info=video_infos,
        pixels=pixels,
        record=EpisodeRecord.of(episode),
    )
    info = DatasetInfo(
        fps=fps,
        features=_dataset_features(episode, video_infos),
        robot_type=episode.info.robot_name,
    )
    return ExportedEpisode(
        data=data,
        traits=episode.traits(),
        info=info,
        depth_left_out=episode.depth_left_out,
        transcoded=tuple(f"{camera.name}, {reason}" for camera, reason in reasons.items() if reason),
        has_statements=bool(language.persistent),
        meanings={
            feature.name: feature.source or ", ".join(dict.fromkeys(filter(None, feature.units)))
            for feature in episode.info.features
        },
        extra={name: EXTRA_FILES.load(name).read(episode) for name in options.extra_files},
    )


def _dataset_features(episode: LeRobotEpisode, video_infos: Mapping[str, dict[str, Any]]) -> dict[str, DatasetFeature]:
    vectors = {
        name: DatasetFeature(dtype="float32", shape=(len(names),), names=names) for name, names in episode.names.items()
    }
    images = {}
    for camera in episode.cameras:
        settings, channels = episode.recording.video_settings(camera.name), 1 if camera.is_depth else 3
        images[camera.feature] = DatasetFeature(
            dtype="video",
            shape=(settings.height, settings.width, channels),
            names=("height", "width", "channels"),
            info=video_infos[camera.feature],
        )
    action = {ACTION: vectors.pop(ACTION)} if ACTION in vectors else {}
    scalars = {name: DatasetFeature(dtype=SCALARS[name], shape=(1,)) for name in episode.scalars}
    language = {} if episode.options.language is None else dict.fromkeys(COLUMNS, LANGUAGE_FEATURE)
    return {**vectors, **images, **action, **scalars, **AUTOMATIC_FEATURES, **language}


def language_of(episode: LeRobotEpisode) -> EpisodeLanguage:
    """Return the statements about the episode; empty unless requested. Without a scene, the only statements are the
    subtasks that the source specifies.
    """
    options, recording = episode.options, episode.recording
    if options.language is None:
        return EpisodeLanguage()
    if episode.scene is None:
        statements = [Statement(row=frame, kind="subtask", text=text) for frame, text in recording.subtasks]
    else:
        kinds = options.spoken
        targets = dict.fromkeys(target for kind, target in rows_of("statements") if kind in kinds)
        derived = chain.from_iterable(pkgutil.resolve_name(target)(recording, kinds) for target in targets)
        statements = sorted(derived, key=lambda statement: statement.row)
    return episode_language(statements, fps=episode.info.fps)


def reasons_to_transcode(episode: LeRobotEpisode) -> dict[ExportCamera, str]:
    """Return colour camera -> reason why its images must be transcoded; "" if they pass through."""
    return {camera: reason_to_transcode(episode, camera) for camera in episode.cameras if not camera.is_depth}


def reason_to_transcode(episode: LeRobotEpisode, camera: ExportCamera) -> str:
    """Explain why the images of a camera cannot pass through; "" if they can."""
    if episode.recording.video_settings(camera.name).codec == "jpeg":
        return "jpeg images are not a video"
    numbers = episode.numbers(camera)
    if (np.diff(numbers) != 1).any():
        return "frames show images again, or leave some out"
    if len(numbers) and _lead(episode.recording, camera.name, int(numbers[0])) > len(numbers):
        return "the keyframe that the first frame needs is further away than the episode is long"
    return ""


def _lead(recording: Recording, camera: str, number: int) -> int:
    if number == 0:
        return 0
    packets = islice(recording.packets(camera), number + 1)
    return number - max((packet.frame_index for packet in packets if packet.is_keyframe), default=0)


def _transcoded_video(episode: LeRobotEpisode, camera: ExportCamera) -> tuple[EncodedVideo, VideoSettings]:
    size = episode.recording.video_settings(camera.name)
    encoder = make_encoder(video=_TRANSCODED, width=size.width, height=size.height, fps=episode.info.fps)
    units = [unit for image in episode.images(camera) for unit in encoder.encode(image)]
    units += encoder.finish()
    lengths = [len(unit) for unit in units]
    codec = _mp4_codec(encoder.settings)
    return EncodedVideo.of_access_units(codec, b"".join(units), lengths), encoder.settings


def recorded_videos(episode: LeRobotEpisode, cameras: Sequence[ExportCamera]) -> dict[str, EncodedVideo]:
    """Return camera feature -> the recorded packets, one per frame, for cameras without a reason to transcode."""
    recording = episode.recording
    recorded = recording.coded_images([camera.name for camera in cameras])
    videos = {}
    for camera in cameras:
        settings, numbers = recording.video_settings(camera.name), episode.numbers(camera)
        lead = _lead(recording, camera.name, int(numbers[0]))
        block = recorded.pop(camera.name)
        if lead or len(block) != len(numbers):
            block = block.select(np.arange(numbers[0] - lead, numbers[-1] + 1, dtype=np.intp))
        videos[camera.feature] = EncodedVideo.of_access_units(_mp4_codec(settings), block.joined(), block.lengths, lead)
    return videos


def _mp4_codec(settings: VideoSettings) -> str:
    return "hevc" if settings.codec == "h265" else settings.codec


def _video_info(settings: VideoSettings) -> dict[str, Any]:
    """Return the `info` of a camera feature: properties of the video and its encoder settings, null where unknown.
    LeRobot transcodes with these settings when it extracts episodes. It replaces null by its default and rejects a GOP
    of 0.
    """
    preset = int(settings.preset) if settings.preset.isdigit() else settings.preset or None
    size = settings.width, settings.height
    return {
        **video_info(size, _mp4_codec(settings), settings.pix_fmt, settings.fps),
        "video.g": settings.gop or None,
        "video.crf": settings.crf,
        "video.preset": preset,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": dict(settings.options),
        "is_depth_map": False,
    }

"""Cameras: poses, pinholes (frusta in the 3D view) and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import batched

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.playback.episode import PlayedEpisode, Video
from demorec.playback.paths import Paths
from demorec.playback.style import FRUSTUM, segment_colors
from demorec.playback.times import indexes
from demorec.scene.scene import Camera

_CODECS = {"h264": rr.VideoCodec.H264, "h265": rr.VideoCodec.H265, "av1": rr.VideoCodec.AV1}
Distances = NDArray[np.uint16] | NDArray[np.float32]
_PICTURES_AT_ONCE = 64
_FRUSTUM_METRES = {"world": 0.22}
_FRUSTUM_ON_ROBOT = 0.04


def log_cameras(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode) -> None:
    """Every camera with what it saw; the coded pictures are passed on as they are."""
    for camera in episode.info.scene.cameras:
        _log_pinhole(recording, paths, episode, camera)
        if camera.name in episode.videos:
            send_video(recording, paths.camera(camera.name), episode.time_ns, episode.videos[camera.name])
        if camera.name in episode.depth:
            send_depth(recording, paths.depth(camera.name), episode.time_ns, _frame_depth(episode, camera.name))
        if camera.name in episode.segmentation:
            _send_segmentation(recording, paths.segmentation(camera.name), episode, episode.segmentation[camera.name])
    if episode.segmentation:
        names = {number: episode.segment_names[value] for value, number in _compact(episode).items() if number > 0}
        colors = segment_colors(names.values())
        labels = [rr.AnnotationInfo(number, name, colors[name]) for number, name in names.items()]
        recording.log(paths.world, rr.AnnotationContext(labels), static=True)


def _log_pinhole(recording: rr.RecordingStream, paths: Paths, episode: PlayedEpisode, camera: Camera) -> None:
    entity = paths.camera(camera.name)
    pinhole = rr.Pinhole(
        image_from_camera=camera.intrinsics,
        resolution=(camera.width, camera.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=_FRUSTUM_METRES.get(camera.mount, _FRUSTUM_ON_ROBOT),
        color=FRUSTUM,
        line_width=-1.0,
    )
    recording.log(entity, pinhole, static=True)
    poses = episode.world_from_camera.get(camera.name)
    if camera.mount == "world":
        pose = camera.mount_from_camera.vector()
        recording.log(entity, rr.Transform3D(translation=pose[:3], quaternion=pose[3:]), static=True)
    elif poses is not None:
        columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
        recording.send_columns(entity, indexes(episode.time_ns, episode.time_ns), columns)


def send_video(recording: rr.RecordingStream, entity: str, frame_times: NDArray[np.int64], video: Video) -> None:
    """Coded pictures as they are, each at its time."""
    if video.codec in _CODECS:
        recording.log(entity, rr.VideoStream(codec=_CODECS[video.codec]), static=True)
    for batch in video.batches():
        if video.codec in _CODECS:
            columns = rr.VideoStream.columns(sample=batch.samples, is_keyframe=batch.is_keyframe)
        else:
            columns = rr.EncodedImage.columns(blob=batch.samples, media_type=["image/jpeg"] * len(batch.samples))
        recording.send_columns(entity, indexes(batch.time_ns, frame_times), columns)


def _frame_depth(episode: PlayedEpisode, camera: str) -> Iterator[tuple[int, Distances]]:
    for time_ns, metres in zip(episode.time_ns.tolist(), episode.depth[camera](), strict=False):
        yield time_ns, np.rint(metres * 1000).clip(0, 65535).astype(np.uint16)


def send_depth(
    recording: rr.RecordingStream,
    entity: str,
    frame_times: NDArray[np.int64],
    pictures: Iterable[tuple[int, Distances]],
) -> None:
    """Distances (H, W), uint16 millimetres or float32 metres, each at its time."""
    for batch in batched(pictures, _PICTURES_AT_ONCE):
        height, width = batch[0][1].shape
        is_metres = batch[0][1].dtype == np.float32
        columns = rr.DepthImage.columns(
            buffer=[picture.tobytes() for _, picture in batch],
            format=[_format(width, height, is_float=is_metres)] * len(batch),
            meter=[1.0 if is_metres else 1000.0] * len(batch),
        )
        times = np.array([time_ns for time_ns, _ in batch])
        recording.send_columns(entity, indexes(times, frame_times), columns)


def _format(width: int, height: int, *, is_float: bool = False) -> rr.components.ImageFormat:
    kind = rr.ChannelDatatype.F32 if is_float else rr.ChannelDatatype.U16
    return rr.components.ImageFormat(width=width, height=height, channel_datatype=kind)


def _compact(episode: PlayedEpisode) -> dict[int, int]:
    """Segment number -> small number, the background 0."""
    values = sorted(episode.segment_names)
    return {value: number for number, value in enumerate(values)}


def _send_segmentation(
    recording: rr.RecordingStream, entity: str, episode: PlayedEpisode, read: Callable[[], Iterator[NDArray[np.int32]]]
) -> None:
    known = np.array(sorted(episode.segment_names))
    for frames in batched(enumerate(read()), _PICTURES_AT_ONCE):
        pictures = [np.searchsorted(known, values).astype(np.uint16) for _, values in frames]
        height, width = pictures[0].shape
        columns = rr.SegmentationImage.columns(
            buffer=[picture.tobytes() for picture in pictures],
            format=[_format(width, height)] * len(pictures),
        )
        times = episode.time_ns[[index for index, _ in frames]]
        recording.send_columns(entity, indexes(times, episode.time_ns), columns)

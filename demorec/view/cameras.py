"""Cameras: poses, pinholes (frusta in the 3D view) and images."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import batched
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from demorec.episode.scene import Scene
from demorec.view.episode import Distances, Playback
from demorec.view.paths import Paths, indexes, log_pose, send_poses
from demorec.view.style import FRUSTUM, name_colors

_CODECS = {"h264": rr.VideoCodec.H264, "h265": rr.VideoCodec.H265, "av1": rr.VideoCodec.AV1}
_PACKETS_AT_ONCE = 256
_IMAGES_AT_ONCE = 64
_FRUSTUM_METRES = {"world": 0.22}
_FRUSTUM_ON_ROBOT = 0.04


def log_cameras(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log every camera with its images; encoded images are passed through unchanged."""
    if episode.scene is not None:
        _log_calibrations(recording, episode, episode.scene)
        _log_segmentations(recording, episode)
    for name in episode.cameras:
        if name in episode.videos:
            _send_video(recording, Paths.camera(name), episode, name)
        if name in episode.depth:
            _send_images(recording, Paths.camera(name, "/depth"), episode.time_ns, episode.distances(name))


def _log_calibrations(recording: rr.RecordingStream, episode: Playback, scene: Scene) -> None:
    for camera in scene.cameras:
        entity = Paths.camera(camera.name)
        pinhole = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=(camera.width, camera.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_METRES.get(camera.mount, _FRUSTUM_ON_ROBOT),
            color=FRUSTUM,
            line_width=-1.0,
        )
        recording.log(entity, pinhole, static=True)
        poses = episode.motion.world_from_camera.get(camera.name)
        if camera.mount == "world":
            log_pose(recording, entity, camera.mount_from_camera.vector())
        elif poses is not None:
            send_poses(recording, entity, episode.time_ns, poses)


def _send_video(recording: rr.RecordingStream, entity: str, episode: Playback, camera: str) -> None:
    """Send encoded images unchanged, each at its time."""
    codec = episode.data.video_settings(camera).codec
    if codec in _CODECS:
        recording.log(entity, rr.VideoStream(codec=_CODECS[codec]), static=True)
    for batch in batched(episode.packets(camera), _PACKETS_AT_ONCE):
        times, samples, are_keyframes = zip(*batch, strict=True)
        if codec in _CODECS:
            columns = rr.VideoStream.columns(sample=samples, is_keyframe=np.array(are_keyframes))
        else:
            columns = rr.EncodedImage.columns(blob=samples, media_type=["image/jpeg"] * len(samples))
        recording.send_columns(entity, indexes(np.array(times), episode.time_ns), columns)


def _send_images(
    recording: rr.RecordingStream,
    entity: str,
    frame_times: NDArray[np.int64],
    images: Iterable[tuple[int, Distances]],
    kind: type[rr.DepthImage] | type[rr.SegmentationImage] = rr.DepthImage,
) -> None:
    """Send distances (H, W), uint16 millimetres or float32 metres, or segment numbers, uint16; each at its time."""
    for batch in batched(images, _IMAGES_AT_ONCE):
        height, width = batch[0][1].shape
        is_float = batch[0][1].dtype == np.float32
        datatype = rr.ChannelDatatype.F32 if is_float else rr.ChannelDatatype.U16
        image_format = rr.components.ImageFormat(width=width, height=height, channel_datatype=datatype)
        unit: dict[str, Any] = {"meter": [1.0 if is_float else 1000.0] * len(batch)} if kind is rr.DepthImage else {}
        columns = kind.columns(
            buffer=[image.tobytes() for _, image in batch], format=[image_format] * len(batch), **unit
        )
        recording.send_columns(entity, indexes(np.array([time_ns for time_ns, _ in batch]), frame_times), columns)


def _log_segmentations(recording: rr.RecordingStream, episode: Playback) -> None:
    """Log segments with small numbers, 0 for the background, and the names of these numbers."""
    segment_names = episode.data.segment_names()
    known = np.array(sorted(segment_names))
    for camera in filter(episode.data.has_segmentation, episode.data.cameras):
        images = zip(episode.time_ns.tolist(), episode.data.segmentation(camera), strict=False)
        numbers = ((time_ns, np.searchsorted(known, values).astype(np.uint16)) for time_ns, values in images)
        entity = Paths.camera(camera, "/segmentation")
        _send_images(recording, entity, episode.time_ns, numbers, rr.SegmentationImage)
    if segment_names:
        names = {number: segment_names[value] for number, value in enumerate(known.tolist()) if number > 0}
        colors = name_colors(names.values())
        labels = [rr.AnnotationInfo(number, name, colors[name]) for number, name in names.items()]
        recording.log(Paths.world, rr.AnnotationContext(labels), static=True)

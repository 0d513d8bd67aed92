"""Coded pictures of a dataset's mp4 files as streams hold them, whoever wrote the files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from av.bitstream import BitStreamFilterContext
from numpy.typing import NDArray

from demorec.core.errors import ExportError, in_words
from demorec.datasets.lerobot.depth import DepthScale
from demorec.datasets.lerobot.files import check_video
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.reader import EpisodePlace

PacketCodec = Literal["h264", "h265", "av1"]
PACKET_CODECS: dict[str, PacketCodec] = {"h264": "h264", "hevc": "h265", "av1": "av1", "libdav1d": "av1"}
"""libav's name of a codec or decoder -> ours."""
_TO_START_CODES = {"h264": "h264_mp4toannexb", "h265": "hevc_mp4toannexb"}
_TEMPORAL_DELIMITER = b"\x12\x00"
"""In front of every temporal unit of AV1 (its specification, section 7.5); mp4 files leave it out."""


@dataclass(frozen=True, kw_only=True)
class Packet:
    """A coded picture of an episode: its frame there, the access unit, and whether it can be decoded by itself.

    Frames below 0 are pictures before the episode, from which its first ones are decoded.
    """

    frame: int
    data: bytes
    is_keyframe: bool


def access_units(stream: av.video.stream.VideoStream, codec: PacketCodec) -> Callable[[av.Packet], bytes]:
    """What makes of a sample of an mp4 file what recordings hold: start codes, or a temporal delimiter, in front."""
    name = _TO_START_CODES.get(codec)
    if name is None:
        return lambda packet: _TEMPORAL_DELIMITER + bytes(packet).removeprefix(_TEMPORAL_DELIMITER)
    bits = BitStreamFilterContext(name, stream)
    return lambda packet: b"".join(bytes(part) for part in bits.filter(packet))


def episode_packets(root: Path, info: DatasetInfo, key: str, place: EpisodePlace) -> Iterator[Packet]:
    """The coded pictures of an episode as they lie in the file.

    Args:
        root: The dataset's folder.
        info: Of it.
        key: Name of the camera feature.
        place: Of the episode.

    Raises:
        ExportError: The video cannot be read.
    """
    with _at_episode(root, info, key, place) as (container, stream, rate):
        codec = PACKET_CODECS.get(stream.codec_context.name)
        if codec is None:
            raise ValueError(f"its codec is {stream.codec_context.name}; {', '.join(PACKET_CODECS)} are read")
        told = str((info.features[key].info or {}).get("video.codec"))
        if PACKET_CODECS.get(told, codec) != codec:
            raise ValueError(f"its codec is {codec}, and meta/info.json says {told}")
        convert, left = access_units(stream, codec), place.length
        lead: list[Packet] = []
        for packet in container.demux(stream):
            if not packet.size or packet.pts is None:
                continue
            # Read before the conversion, which empties the packet.
            frame, is_keyframe = round(packet.pts * rate) - place.videos[key][1], packet.is_keyframe
            data = convert(packet)
            read = Packet(frame=frame, data=data, is_keyframe=is_keyframe)
            if is_keyframe:
                lead.clear()
            if frame < 0:
                lead.append(read)
            elif frame < place.length:
                yield from (*lead, read)
                lead.clear()
                left -= 1
            if not left:
                return


def episode_distances(root: Path, info: DatasetInfo, key: str, place: EpisodePlace) -> Iterator[NDArray[np.float32]]:
    """(H, W) metres of every frame of an episode, 0 where nothing was measured; arguments as of `episode_packets`.

    Raises:
        ExportError: The video cannot be read, or lacks one of them.
    """
    height, width = info.features[key].shape[:2]
    try:
        metres = DepthScale.of(info.features[key].info or {}).shown()
    except ValueError as error:
        raise ExportError(f"The depth of {key} cannot be read ({error}): {root / INFO_PATH}") from error
    with _at_episode(root, info, key, place) as (container, stream, rate):
        if (found := (stream.codec_context.height, stream.codec_context.width)) != (height, width):
            raise ValueError(f"it has {found[1]}x{found[0]} pixels, and meta/info.json says {width}x{height}")
        # A few bytes can announce pictures of gigabytes; coded pictures are whole blocks of at most 128 pixels.
        stream.codec_context.options = {"max_pixels": str((height + 128) * (width + 128))}
        number = 0
        for picture in container.decode(stream) if place.length else ():
            frame = -1 if picture.pts is None else round(picture.pts * rate) - place.videos[key][1]
            if frame < 0:
                continue
            if frame != number:
                break
            yield metres[np.minimum(picture.to_ndarray(format="gray12le"), len(metres) - 1)]
            number += 1
            if number == place.length:
                return
        if number < place.length:
            raise ValueError(f"episode {place.episode_index} has {place.length} frames, and frame {number} no picture")


@contextmanager
def _at_episode(
    root: Path, info: DatasetInfo, key: str, place: EpisodePlace
) -> Iterator[tuple[av.container.InputContainer, av.video.stream.VideoStream, Fraction]]:
    """The video of an episode, before its first picture or earlier; the last value is frames a tick of its clock."""
    position, first = place.videos[key]
    path = root / position.path(info.video_path or VIDEO_PATH, key)
    check_video(path)
    try:
        with av.open(str(path), format="mp4") as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"  # starting threads costs more than what they would save
            assert stream.time_base is not None
            container.seek(round(first / (info.fps * stream.time_base)), stream=stream)
            yield container, stream, info.fps * stream.time_base
    except (OSError, ValueError, IndexError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be read ({in_words(error)}): {path}") from error

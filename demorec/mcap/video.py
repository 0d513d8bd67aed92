"""Encoding of images to packets, and decoding.

Every image is encoded once, while recording; the packets are stored unchanged in the recording and later in the
dataset. There is one encoder per camera and episode, with one thread each (bit-exact on all machines of a type, and a
pool of workers already fills the cores). Images are not reordered: packet t shows frame t.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Literal, cast

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray
from PIL import Image

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError, describe_error

Rgb = NDArray[np.uint8]
Codec = Literal["h264", "h265", "av1", "jpeg", "16UC1", "32FC1"]

# SVT-AV1 prints its settings to standard error unless this says "errors only"; it is read at start.
os.environ.setdefault("SVT_LOG", "1")

# Code points of ITU-T H.273, the same in H.264 and AV1: sRGB images through libswscale's default matrix (BT.601, 16 to
# 235). Without them a player guesses, and many guess BT.709: (200, 30, 30) is then shown as (214, 45, 28).
_LIMITED_RANGE = 1
_PRIMARIES_BT709 = 1
_TRANSFER_SRGB = 13
_MATRIX_BT601 = 6


DECODERS = {"h264": "h264", "h265": "hevc", "av1": "libdav1d"}
"""Codec -> FFmpeg's name of the decoder, for codecs with images that depend on earlier ones."""
_MAX_UNITS = 256
"""Maximum number of units of an encoded image before its first slice."""
_PIXEL_FORMATS = {"jpeg": "yuvj420p", "16UC1": "gray16le", "32FC1": "grayf32le"}
"""Codec -> FFmpeg's name of the pixel format, for codecs with independent images."""
_DEEP_GRAY = re.compile(r"gray(9|1\d|f32)")
"""FFmpeg's single-channel pixel formats over 8 bits."""
_WITH_CHROMA_FORMAT = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))
"""H.264 profiles whose parameter sets state the chroma format (ITU-T H.264, 7.3.2.1.1)."""
_SPS_BYTES = 24
"""Maximum length of the fields before and including the bit depth."""


@dataclass(frozen=True, kw_only=True)
class VideoSettings:
    """Encoding of one camera's images, as needed by a dataset's metadata and an mp4 file."""

    codec: Codec  # of the bit stream; for depth the encoding of its distances
    encoder: str = ""  # FFmpeg's name of the encoder, "" for jpeg and for packets that arrived encoded
    width: int
    height: int
    fps: int
    pix_fmt: str  # FFmpeg's name of the pixel format
    gop: int  # images from one keyframe to the next; 0 if unknown, for packets that arrived encoded
    crf: int | None = None  # constant rate factor; None for jpeg
    preset: str = ""
    options: dict[str, str] = field(default_factory=dict)  # further encoder options, as passed to FFmpeg
    jpeg_quality: int | None = None  # 1..100; None unless the codec is jpeg


def settings_of_coded(codec: Codec, width: int, height: int, fps: int) -> VideoSettings:
    """Build the settings of packets that arrived encoded, with unknown encoder."""
    pix_fmt, gop = _PIXEL_FORMATS.get(codec, "yuv420p"), 1 if codec in _PIXEL_FORMATS else 0
    return VideoSettings(codec=codec, width=width, height=height, fps=fps, pix_fmt=pix_fmt, gop=gop)


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoPacket:
    """One encoded image: an H.264 or H.265 access unit (Annex B), an AV1 temporal unit (OBUs) or a JPEG file.

    Parameter sets precede every keyframe, which can be decoded without the packets before it.
    """

    frame_index: int
    time_ns: int
    data: bytes
    is_keyframe: bool


def size_problem(video: VideoConfig, width: int, height: int) -> str:
    """Return why images of this size cannot be encoded, and the fix; "" if they can.

    libx264 refuses odd sizes; for AV1, libswscale leaves the last colour column of an odd width uninitialised.
    """
    if video.codec == "jpeg" or width % 2 == height % 2 == 0:
        return ""
    return (
        f"images of {width}x{height} pixels cannot be {video.codec} video, which needs even sizes: cut or scale them, "
        'or use the codec jpeg (--codec jpeg, VideoConfig(codec="jpeg")), of which no LeRobot dataset can be made'
    )


class _JpegEncoder:
    def __init__(self, video: VideoConfig, width: int, height: int, fps: int) -> None:
        settings = settings_of_coded(video.codec, width, height, fps)
        self.settings = replace(settings, jpeg_quality=video.jpeg_quality)

    def encode(self, image: Rgb) -> list[bytes]:
        """Encode one image; return the packets that are ready, oldest first."""
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, format="JPEG", quality=self.settings.jpeg_quality, subsampling="4:2:0")
        return [buffer.getvalue()]

    def finish(self) -> list[bytes]:
        """Return the remaining packets."""
        return []


class _StreamEncoder:
    def __init__(self, video: VideoConfig, width: int, height: int, fps: int) -> None:
        if video.codec == "h264":
            # Keyframes at a fixed distance; no reordering, no delay. Zero latency also disables x264's macroblock tree,
            # which reads uninitialised memory (seen with MALLOC_PERTURB_), so that packets would depend on the
            # process's history. The same quality takes about 5 % more bytes at GOP 2 without it. Without
            # "cpu-independent", x264 takes shortcuts that differ between CPUs; it costs no time and 1.5 % bytes.
            options = {"bf": "0", "sc_threshold": "0", "tune": "zerolatency", "x264-params": "cpu-independent=1"}
            encoder, crf, preset = "libx264", 23, "veryfast"
        else:
            # Low delay, one thread: frames leave in the order and at the pace of their arrival.
            encoder, crf, preset, options = "libsvtav1", 30, "12", {"svtav1-params": "fast-decode=0:lp=1:pred-struct=1"}
        if problem := size_problem(video, width, height):
            raise ConfigError(f"{problem[0].upper()}{problem[1:]}.")
        self.settings = replace(
            settings_of_coded(video.codec, width, height, fps),
            encoder=encoder,
            gop=video.gop,
            crf=crf if video.crf is None else video.crf,
            preset=preset if video.preset is None else video.preset,
            options=options,
        )
        try:
            context = av.CodecContext.create(encoder, "w")
            context = cast(av.VideoCodecContext, context)
            context.width, context.height, context.pix_fmt = width, height, self.settings.pix_fmt
            self._time_base = Fraction(1, fps)
            context.time_base, context.framerate = self._time_base, Fraction(fps, 1)
            context.color_range, context.colorspace = _LIMITED_RANGE, _MATRIX_BT601
            context.color_primaries, context.color_trc = _PRIMARIES_BT709, _TRANSFER_SRGB
            context.gop_size = video.gop
            context.thread_count = 1
            quality = {"g": str(video.gop), "crf": str(self.settings.crf), "preset": self.settings.preset}
            context.options = {**quality, **options}
            with ordinary_scheduling():
                context.open()
        except (av.FFmpegError, ValueError) as error:
            raise ConfigError(
                f"The video encoder {encoder} does not start with {width}x{height} pixels, crf {self.settings.crf}, "
                f"preset {self.settings.preset} ({describe_error(error)}): choose another preset, or --codec jpeg."
            ) from error
        self._context = context
        self._num_images = 0

    def encode(self, image: Rgb) -> list[bytes]:
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = self._num_images, self._time_base
        self._num_images += 1
        return [bytes(packet) for packet in self._context.encode(frame)]

    def finish(self) -> list[bytes]:
        return [bytes(packet) for packet in self._context.encode(None)]


Encoder = _JpegEncoder | _StreamEncoder
"""Encoder of the images of one camera, in order."""


def make_encoder(video: VideoConfig, width: int, height: int, fps: int) -> Encoder:
    """Make an encoder as configured; RecordingError if this build of FFmpeg lacks the codec."""
    return (_JpegEncoder if video.codec == "jpeg" else _StreamEncoder)(video, width, height, fps)


def decode(settings: VideoSettings, packets: Iterable[VideoPacket]) -> Iterator[Rgb]:
    """Decode packets in order, starting at a keyframe: (H, W, 3) uint8 RGB, one per packet.

    RecordingError if a packet cannot be decoded, has another size, or images are missing at the end.
    """
    shape = (settings.height, settings.width, 3)
    images = _decode_jpeg(settings, packets) if settings.codec == "jpeg" else _decode_stream(settings, packets)
    for image in images:
        if image.shape != shape:
            raise RecordingError(
                f"An image is {image.shape[1]}x{image.shape[0]} pixels, but the metadata states "
                f"{settings.width}x{settings.height}."
            )
        yield image


def _decode_jpeg(settings: VideoSettings, packets: Iterable[VideoPacket]) -> Iterator[Rgb]:
    for packet in packets:
        try:
            with Image.open(io.BytesIO(packet.data), formats=("JPEG",)) as image:
                if image.width * image.height > settings.width * settings.height:  # before anything is unpacked
                    raise OSError(f"{image.width}x{image.height} pixels")
                yield np.asarray(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            reason = describe_error(error)
            raise RecordingError(f"The image of frame {packet.frame_index} is not a valid JPEG ({reason}).") from error


def _decode_stream(settings: VideoSettings, packets: Iterable[VideoPacket]) -> Iterator[Rgb]:
    context = cast(av.VideoCodecContext, av.CodecContext.create(DECODERS.get(settings.codec, settings.codec), "r"))
    context.thread_count = 1
    # A few bytes can announce images of gigabytes; encoded images are whole blocks of at most 128 pixels.
    context.options = {"max_pixels": str((settings.width + 128) * (settings.height + 128))}
    num_packets = num_images = 0
    # Shared by all images: a frame's own is set up again each time, which takes as long as decoding.
    reformatter = VideoReformatter()
    try:
        for packet in chain(packets, [None]):
            raw = None if packet is None else av.Packet(packet.data)
            if raw is not None:
                raw.pts = num_packets
                num_packets += 1
            for frame in context.decode(raw):
                num_images += 1
                yield cast(Rgb, reformatter.reformat(frame, format="rgb24").to_ndarray())
    except (av.FFmpegError, ValueError) as error:
        raise RecordingError(f"The {settings.codec} video cannot be decoded near frame {num_images}.") from error
    if num_images != num_packets:
        raise RecordingError(f"{num_packets} packets of {settings.codec} video gave {num_images} images.")


def is_keyframe(codec: str, data: bytes) -> bool:
    """Check whether an encoded image can be decoded without earlier ones.

    H.264 (ITU-T H.264, table 7-1): an access unit with a slice of type 5 (IDR). H.265 (ITU-T H.265, table 7-1): one
    with a slice of the types 16 to 21 (IRAP). AV1: our encoder puts a sequence header (OBU type 1) before keyframes and
    nowhere else.
    """
    if codec == "h264":
        return any(kind == 5 for kind, _ in nal_units(codec, data))
    if codec in ("h265", "hevc"):
        return any(16 <= kind <= 21 for kind, _ in nal_units(codec, data))
    if codec == "av1":
        return any(kind == 1 for kind, _, _ in obu_units(data))
    return True


def nal_units(codec: str, data: bytes) -> Iterator[tuple[int, int]]:
    """Yield type and offset of an access unit's NAL units, up to the first slice, `_MAX_UNITS` at most."""
    position = data.find(b"\x00\x00\x01")
    for _ in range(_MAX_UNITS):
        if not 0 <= position < len(data) - 3:
            return
        head = data[position + 3]
        kind = head & 31 if codec == "h264" else head >> 1 & 63
        yield kind, position
        if kind in (1, 5) if codec == "h264" else kind < 32:
            return
        position = data.find(b"\x00\x00\x01", position + 3)


def deep_gray(codec: str, pixel_format: str, parameters: bytes) -> str:
    """Name the pixel format of a video that holds a measurement; "" for colour.

    FFmpeg's `pixel_format` is a colour format for H.264 without chroma, so the video's parameter sets are read too, as
    in an access unit or in an mp4 file.
    """
    if codec == "h264" and (depth := _luma_bits_without_chroma(parameters)) > 8:
        return f"gray{depth}le"
    return pixel_format if _DEEP_GRAY.match(pixel_format) else ""


def _luma_bits_without_chroma(parameters: bytes) -> int:
    """Bits per pixel of H.264 without chroma; 0 for colour, or without a sequence parameter set."""
    is_mp4 = parameters[:1] == b"\x01"  # one set follows its length (ISO/IEC 14496-15, 5.3.3.1)
    begins = [8] if is_mp4 else [place + 3 for kind, place in nal_units("h264", parameters) if kind == 7]
    sps = parameters[begins[0] :][:_SPS_BYTES] if begins else b""
    if len(sps) < _SPS_BYTES // 2 or sps[1] not in _WITH_CHROMA_FORMAT:
        return 0
    bits = "".join(f"{byte:08b}" for byte in sps[4:].replace(b"\0\0\3", b"\0\0"))
    values: list[int] = []  # identifier, chroma format, luma bits over 8, as Exp-Golomb codes
    while len(values) < 3:
        zeros = len(bits) - len(bits.lstrip("0"))
        if 2 * zeros >= len(bits):
            return 0
        values.append(int(bits[: 2 * zeros + 1], 2) - 1)
        bits = bits[2 * zeros + 1 :]
    return values[2] + 8 if values[1] == 0 else 0


def obu_units(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (type, start, end) of the open bitstream units of a temporal unit; the last one may end after the data."""
    position = 0
    while position < len(data):
        start, head = position, data[position]
        position += 2 if head & 4 else 1
        size = shift = 0
        while position < len(data):
            byte = data[position]
            size |= (byte & 127) << shift
            shift += 7
            position += 1
            if not byte & 128:
                break
        position += size
        yield (head >> 3) & 15, start, position


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Restore the scheduling of this process's threads at exit; new threads get the caller's.

    SVT-AV1 gives its threads, and the one that starts it, the highest real-time priority if run by root (as in most
    containers). Everything that the process starts later inherits it, and all other processes on the machine stall.
    """
    own = (os.sched_getscheduler(0), os.sched_getparam(0))
    before = dict(_scheduling())
    try:
        yield
    finally:
        for thread, found in _scheduling():
            wanted = before.get(thread, own)
            if found[0] != wanted[0]:
                with suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, *wanted)


def _scheduling() -> Iterator[tuple[int, tuple[int, os.sched_param]]]:
    """Yield (thread, (policy, parameters)) of every thread of this process."""
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            thread = int(task.name)
            yield thread, (os.sched_getscheduler(thread), os.sched_getparam(thread))

"""Mp4 files of remuxed images, read back with FFmpeg: timing, images, index in front."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.present import present

from demorec.core.config import VideoConfig
from demorec.core.errors import ExportError
from demorec.datasets.lerobot.mp4 import EncodedVideo, Mp4Writer
from demorec.mcap import VideoPacket, VideoSettings
from demorec.mcap.video import decode, is_keyframe, make_encoder

WIDTH, HEIGHT = 64, 48


def images(count: int, seed: int = 0) -> list[np.ndarray[Any, Any]]:
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    return [np.roll(base, 3 * index, axis=1) for index in range(count)]


def encoded(
    codec: str, count: int, *, fps: int = 30, seed: int = 0, crf: int | None = None
) -> tuple[VideoSettings, list[bytes]]:
    encoder = make_encoder(video=VideoConfig(codec=codec, crf=crf), width=WIDTH, height=HEIGHT, fps=fps)  # type: ignore[arg-type]
    packets = [packet for image in images(count, seed) for packet in encoder.encode(image)] + encoder.finish()
    return encoder.settings, packets


def coded(
    codec: str, count: int, *, fps: int = 30, seed: int = 0, crf: int | None = None
) -> tuple[EncodedVideo, list[np.ndarray[Any, Any]]]:
    """A video and the images that a decoder makes of its packets."""
    settings, packets = encoded(codec, count, fps=fps, seed=seed, crf=crf)
    video_packets = [
        VideoPacket(frame_index=i, time_ns=i, data=data, is_keyframe=is_keyframe(codec, data))
        for i, data in enumerate(packets)
    ]
    decoded = list(decode(settings, video_packets))
    return video_of(codec, packets), decoded


def video_of(codec: str, packets: list[bytes]) -> EncodedVideo:
    lengths = [len(packet) for packet in packets]
    return EncodedVideo.of_access_units(codec, b"".join(packets), lengths)


@pytest.mark.parametrize(("codec", "fps"), [("h264", 30), ("h264", 7), ("h264", 240), ("av1", 30), ("av1", 15)])
def test_every_image_and_time_comes_back(tmp_path: Path, codec: str, fps: int) -> None:
    first, first_images = coded(codec, 9, fps=fps)
    second, second_images = coded(codec, 4, fps=fps, seed=1)
    writer = Mp4Writer(tmp_path / "a.mp4", first, fps=fps)
    writer.add(first)
    writer.add(second)
    assert not (tmp_path / "a.mp4").exists()  # no partial file under the final name
    writer.close()
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == stream.base_rate == fps
        assert stream.frames == 13
        assert present(stream.duration) * present(stream.time_base) == Fraction(13, fps)
        frames = list(container.decode(stream))
    assert [present(frame.pts) * present(frame.time_base) for frame in frames] == [Fraction(n, fps) for n in range(13)]
    for frame, expected in zip(frames, first_images + second_images, strict=True):
        assert np.array_equal(frame.to_ndarray(format="rgb24"), expected)


def test_invalid_images_are_refused(tmp_path: Path) -> None:
    _, units = encoded("av1", 3)
    for nothing in (b"", b"\x12\x00"):  # the second is a temporal delimiter alone
        with pytest.raises(ExportError, match="no image"):
            video_of("av1", [*units, nothing])
    garbage = video_of("h264", [SHORT + NAL["sps"] + SHORT + NAL["idr"]])
    with pytest.raises(ExportError, match=r"cannot be written.*a\.mp4"):
        Mp4Writer(tmp_path / "a.mp4", garbage, fps=30)
    assert list(tmp_path.iterdir()) == []


def samples_of(video: EncodedVideo) -> list[bytes]:
    assert isinstance(video.samples, bytes)
    ends = np.cumsum(video.sizes).tolist()
    assert ends[-1] == len(video.samples)
    return [video.samples[a:b] for a, b in zip([0, *ends], ends, strict=False)]


@pytest.mark.parametrize("codec", ["h264", "av1", "hevc"])
def test_the_packets_are_what_ffmpeg_would_write(codec: str) -> None:
    """Against libav's own muxer: the same samples, and the keyframes that its parser finds."""
    units = hevc_units(4) if codec == "hevc" else encoded(codec, 6)[1]
    video = video_of(codec, units)
    demuxer = {"h264": "h264", "av1": "obu", "hevc": "hevc"}[codec]
    buffer = io.BytesIO()
    source = av.open(io.BytesIO(units[0]), format=demuxer)
    with av.open(buffer, "w", format="mp4") as target:
        stream = target.add_stream_from_template(source.streams.video[0], opaque=True)
        for number, unit in enumerate(units):
            packet = av.Packet(unit)
            packet.pts = packet.dts = number
            packet.duration, packet.time_base, packet.stream = 1, Fraction(1, 30), stream
            target.mux_one(packet)
    buffer.seek(0)
    expected = [bytes(packet) for packet in av.open(buffer, "r").demux(video=0) if packet.size]
    assert samples_of(video) == expected
    if codec == "h264":
        parsed = av.open(io.BytesIO(b"".join(units)), "r", format=demuxer).demux(video=0)
        assert video.is_keyframe.tolist() == [packet.is_keyframe for packet in parsed if packet.size]


def hevc_units(count: int) -> list[bytes]:
    context = av.CodecContext.create("libx265", "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
    context.options = {"x265-params": "bframes=0:repeat-headers=1:log-level=none"}
    frames = [av.VideoFrame.from_ndarray(image, format="rgb24") for image in images(count)]
    packets = [packet for frame in frames for packet in context.encode(frame.reformat(format="yuv420p"))]
    return [bytes(packet) for packet in packets + context.encode(None)]


NAL = {"idr": b"\x65\x88\x84", "slice": b"\x41\x9a\x02", "sps": b"\x67\x42\x1e", "sei": b"\x06\x05\x01\x80"}
LONG, SHORT = b"\x00\x00\x00\x01", b"\x00\x00\x01"


@pytest.mark.parametrize(
    ("units", "expected", "keyframes"),
    [
        ([(LONG, "sps", SHORT, "idr"), (SHORT, "slice")], [("sps", "idr"), ("slice",)], [True, False]),
        ([(LONG, "sei", LONG, "slice"), (LONG, "slice", SHORT, "slice")], [("sei", "slice"), ("slice",) * 2], [0, 0]),
        # Superfluous zeros: after a unit, and several before the first start code.
        ([(SHORT, "idr", b"\0\0\0"), (SHORT, "slice", b"\0")], [("idr",), ("slice",)], [1, 0]),
        ([(b"\0\0\0", SHORT, "idr"), (SHORT, "slice")], [("idr",), ("slice",)], [1, 0]),
    ],
)
def test_every_way_to_put_start_codes(
    units: list[tuple[str | bytes, ...]], expected: list[tuple[str, ...]], keyframes: list[int]
) -> None:
    """Expected values are built by hand from ITU-T H.264 annex B: byte_stream_nal_unit with leading_zero_8bits and
    trailing_zero_8bits.
    """
    coded_units = [b"".join(NAL[part] if isinstance(part, str) else part for part in unit) for unit in units]
    video = video_of("h264", coded_units)
    wanted = [b"".join(len(NAL[name]).to_bytes(4, "big") + NAL[name] for name in names) for names in expected]
    assert samples_of(video) == wanted
    assert video.is_keyframe.tolist() == [bool(value) for value in keyframes]


@pytest.mark.parametrize("unit", [b"", b"no video at all", b"\x01" + NAL["slice"], NAL["slice"] + SHORT + NAL["slice"]])
def test_a_packet_without_its_start_code_is_refused(unit: bytes) -> None:
    """This includes a previous packet whose end would complete a start code."""
    for before in (SHORT + NAL["idr"], SHORT + NAL["idr"] + b"\0\0"):
        with pytest.raises(ExportError, match="start code"):
            video_of("h264", [before, unit])

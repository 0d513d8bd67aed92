"""Mp4 files of remuxed pictures, read back with FFmpeg: timing, pictures, index in front."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from demorec.config import VideoConfig
from demorec.errors import ExportError
from demorec.export.bitstream import mp4_sample, parameter_sets
from demorec.export.depth import code_values, depth_video, quantised
from demorec.export.mp4 import CodedPicture, CodedVideo, Mp4Writer
from demorec.recording import VideoPacket
from demorec.recording.video import decode, is_keyframe, make_encoder

WIDTH, HEIGHT = 64, 48


def pictures(count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    base = rng.integers(0, 255, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    return [np.roll(base, 3 * index, axis=1) for index in range(count)]


def coded(
    codec: str, count: int, *, fps: int = 30, seed: int = 0, crf: int | None = None
) -> tuple[CodedVideo, list[np.ndarray]]:
    """A video and what a decoder makes of its packets."""
    encoder = make_encoder(video=VideoConfig(codec=codec, crf=crf), width=WIDTH, height=HEIGHT, fps=fps)  # type: ignore[arg-type]
    packets = [packet for picture in pictures(count, seed) for packet in encoder.encode(picture)] + encoder.finish()
    video_packets = [
        VideoPacket(frame_index=i, time_ns=i, data=data, is_keyframe=is_keyframe(codec, data))
        for i, data in enumerate(packets)
    ]
    decoded = list(decode(encoder.settings, video_packets))
    parts = [CodedPicture(data=packet.data, is_keyframe=packet.is_keyframe) for packet in video_packets]
    return CodedVideo(codec=codec, width=WIDTH, height=HEIGHT, pictures=parts), decoded


@pytest.mark.parametrize(("codec", "fps"), [("h264", 30), ("h264", 7), ("h264", 240), ("av1", 30), ("av1", 15)])
def test_every_picture_and_time_comes_back(tmp_path: Path, codec: str, fps: int) -> None:
    first, first_pictures = coded(codec, 9, fps=fps)
    second, second_pictures = coded(codec, 4, fps=fps, seed=1)
    writer = Mp4Writer(tmp_path / "a.mp4", first, fps=fps)
    writer.add(first)
    writer.add(second)
    assert not (tmp_path / "a.mp4").exists()  # nothing half written under the final name
    writer.close()
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.base_rate, stream.frames) == (fps, fps, 13)
        assert stream.duration * stream.time_base == Fraction(13, fps)
        frames = list(container.decode(stream))
    assert [frame.pts * frame.time_base for frame in frames] == [Fraction(n, fps) for n in range(13)]
    for frame, expected in zip(frames, first_pictures + second_pictures, strict=True):
        assert np.array_equal(frame.to_ndarray(format="rgb24"), expected)


def test_the_index_is_in_front_and_seeking_finds_keyframes(tmp_path: Path) -> None:
    video, expected = coded("h264", 20)
    writer = Mp4Writer(tmp_path / "a.mp4", video, fps=30)
    writer.add(video)
    writer.close()
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        container.seek(round(13 / 30 / stream.time_base), stream=stream)
        frame = next(container.decode(stream))
        assert frame.key_frame
        number = round(frame.time * 30)
        assert number in (12, 13)
        assert np.array_equal(frame.to_ndarray(format="rgb24"), expected[number])


def test_the_packets_are_what_ffmpeg_would_write(tmp_path: Path) -> None:
    """Against libav's own muxer: the same samples for every codec."""
    depth, _ = depth_video([np.full((HEIGHT, WIDTH), 0.5 + n / 10, dtype=np.float32) for n in range(4)], fps=30)
    for video in (coded("h264", 6)[0], coded("av1", 6)[0], depth):
        demuxer = {"h264": "h264", "av1": "obu", "hevc": "hevc"}[video.codec]
        buffer = io.BytesIO()
        source = av.open(io.BytesIO(video.pictures[0].data), format=demuxer)
        with av.open(buffer, "w", format="mp4") as target:
            stream = target.add_stream_from_template(source.streams.video[0], opaque=True)
            for number, picture in enumerate(video.pictures):
                packet = av.Packet(picture.data)
                packet.pts = packet.dts = number
                packet.duration, packet.time_base, packet.stream = 1, Fraction(1, 30), stream
                packet.is_keyframe = picture.is_keyframe
                target.mux_one(packet)
        buffer.seek(0)
        expected = [bytes(packet) for packet in av.open(buffer).demux(video=0) if packet.size]
        assert [mp4_sample(video.codec, picture.data) for picture in video.pictures] == expected


def test_parameter_sets_tell_settings_apart() -> None:
    same, again, other = coded("h264", 2)[0], coded("h264", 2, seed=5)[0], coded("h264", 2, crf=40)[0]
    assert same.parameter_sets() == again.parameter_sets() != other.parameter_sets()
    av1, av1_again = coded("av1", 2)[0], coded("av1", 2, seed=5)[0]
    assert av1.parameter_sets() == av1_again.parameter_sets()


def test_a_video_that_does_not_start_with_a_keyframe_is_refused() -> None:
    video, _ = coded("h264", 4)
    assert not video.pictures[1].is_keyframe
    cut = CodedVideo(codec="h264", width=WIDTH, height=HEIGHT, pictures=video.pictures[1:])
    with pytest.raises(ExportError, match="keyframe"):
        cut.parameter_sets()
    with pytest.raises(ExportError, match="start code"):
        parameter_sets("h264", b"no video at all")


def test_depth_codes_are_those_of_lerobots_formula_and_are_kept_without_loss(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    maps = [rng.uniform(0, 11, (HEIGHT, WIDTH)).astype(np.float32) for _ in range(3)]
    video, histogram = depth_video(maps, fps=30)
    writer = Mp4Writer(tmp_path / "d.mp4", video, fps=30)
    writer.add(video)
    writer.close()
    with av.open(str(tmp_path / "d.mp4")) as container:
        decoded = [frame.to_ndarray(format="gray12le") for frame in container.decode(video=0)]
    assert len(decoded) == 3
    for found, expected in zip(decoded, maps, strict=True):
        assert np.array_equal(found, quantised(expected))
        inside = (expected >= 0.01) & (expected <= 10)
        error = np.abs(code_values()[found] - expected)[inside]
        assert error.max() < 0.5 * 13.5 * np.log(13.5 / 3.51) / 4095 * 1.01  # half a step at 10 m
    assert histogram.counts.sum() == 3 * HEIGHT * WIDTH
    assert histogram.num_pictures == 3

"""The encoder: its settings, its independence of the process's past, and its short delay."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from support.recording import Codec, make_episode

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.mcap.video import VideoPacket, decode, is_keyframe, make_encoder


@pytest.mark.parametrize("codec", ["h264", "av1", "jpeg"])
def test_the_delay_is_short(codec: Codec) -> None:
    """Frames that an encoder buffers are lost in a crash."""
    _, frames, _ = make_episode(num_frames=40, cameras=("front",))
    encoder = make_encoder(video=VideoConfig(codec=codec, gop=30), width=64, height=48, fps=30)
    out = 0
    for number, frame in enumerate(frames, start=1):
        out += len(encoder.encode(frame.images["front"].color))
        assert number - out <= (1 if codec == "av1" else 0)
    assert out + len(encoder.finish()) == 40


def test_broken_video_is_one_sentence() -> None:
    _, frames, _ = make_episode(num_frames=4, cameras=("front",))
    broken: dict[Codec, bytes] = {"h264": b"\0\0\0\1\x65junk", "av1": b"\x12\0junk", "jpeg": b"\xff\xd8\xffjunk"}
    for codec, junk in broken.items():
        encoder = make_encoder(video=VideoConfig(codec=codec), width=64, height=48, fps=30)
        data = [packet for frame in frames for packet in encoder.encode(frame.images["front"].color)]
        data += encoder.finish()
        data[1] = junk
        packets = [
            VideoPacket(frame_index=index, time_ns=0, data=packet, is_keyframe=is_keyframe(codec, packet))
            for index, packet in enumerate(data)
        ]
        with pytest.raises(RecordingError) as caught:
            list(decode(encoder.settings, packets))
        assert "\n" not in str(caught.value)


def test_a_size_that_differs_from_the_settings() -> None:
    encoder = make_encoder(video=VideoConfig(codec="jpeg"), width=64, height=48, fps=30)
    other = make_encoder(video=VideoConfig(codec="jpeg"), width=32, height=32, fps=30)
    (data,) = other.encode(np.zeros((32, 32, 3), dtype=np.uint8))
    packet = VideoPacket(frame_index=0, time_ns=0, data=data, is_keyframe=True)
    with pytest.raises(RecordingError, match="An image is 32x32 pixels, but the metadata states 64x48"):
        list(decode(encoder.settings, [packet]))


class WithoutVectors:
    """A context of x264 that uses no vector instructions."""

    create = av.CodecContext.create

    def __init__(self, *words: Any) -> None:
        self.__dict__["context"] = WithoutVectors.create(*words)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.context, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "options":
            value = {**value, "x264-params": value["x264-params"] + ":asm=0"}
        setattr(self.context, name, value)


def test_packets_do_not_depend_on_the_instructions_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    times, rows, columns = np.mgrid[0:12, 0:224, 0:224]
    waves = 128 + 100 * np.sin(rows / 9 + times / 3) * np.cos(columns / 13 - times / 5)
    images = np.stack([waves, np.roll(waves, 40, axis=2), 255 - waves], axis=-1).astype(np.uint8)

    def encoded() -> list[bytes]:
        encoder = make_encoder(video=VideoConfig(), width=224, height=224, fps=30)
        return [packet for image in images for packet in encoder.encode(image)] + encoder.finish()

    before = encoded()
    monkeypatch.setattr(av, "CodecContext", SimpleNamespace(create=WithoutVectors))
    assert encoded() == before


@pytest.mark.parametrize(("codec", "decoder"), [("h264", "h264"), ("av1", "libdav1d")])
def test_a_stream_specifies_its_colour_space(codec: Codec, decoder: str) -> None:
    """Its luma and chroma give the image back by the matrix and range in its metadata."""
    import av

    colours = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 40]], dtype=np.uint8)
    image = np.repeat(np.repeat(colours[np.newaxis], 32, axis=1), 64, axis=0)
    encoder = make_encoder(video=VideoConfig(codec=codec, crf=5), width=128, height=64, fps=30)
    packets = [*encoder.encode(image), *encoder.finish()]
    context = av.CodecContext.create(decoder, "r")
    assert isinstance(context, av.VideoCodecContext)
    frames = [frame for packet in packets for frame in context.decode(av.Packet(packet))] + context.decode(None)
    # Code points of ITU-T H.273: limited range, primaries of BT.709, transfer of sRGB, matrix of BT.601.
    assert (context.color_range, context.color_primaries, context.color_trc, context.colorspace) == (1, 1, 13, 6)
    planes = frames[0].to_ndarray().astype(float)  # 64 rows of luma, then 16 of U and 16 of V
    luma = (planes[32, 16::32] - 16) / 219
    blue, red = ((planes[row].reshape(2, 64)[0, 8::16] - 128) / 224 for row in (72, 88))
    # ITU-R BT.601: Y = 0.299 R + 0.587 G + 0.114 B, Pb = (B - Y) / 1.772, Pr = (R - Y) / 1.402
    r, b = luma + 1.402 * red, luma + 1.772 * blue
    shown = 255 * np.stack([r, (luma - 0.299 * r - 0.114 * b) / 0.587, b], axis=-1)
    np.testing.assert_allclose(shown, colours, atol=4)

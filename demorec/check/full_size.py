"""Some frames of a camera at their full size, against what the recorded numbers and the camera's encoder make of them.

The drawn images are those that were encoded, so what an encoder of the same settings makes of them is what must have
been recorded: what is left is neither the encoder's error nor its quality. A later frame's quality depends on the
frames before, which are taken from the recording. Depth and labels are stored without loss and compared pixel by pixel.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import limit_table
from demorec.check.cells import CellGrid
from demorec.core.config import VideoConfig
from demorec.core.geometry import Array
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, decode, is_keyframe, make_encoder

BLOCK = 8
"""Pixels a side of the parts of an image that are judged by themselves: those of a transform in H.264."""
LEAD = 6
"""Frames before those that are compared, by which the encoder finds its quality: its memory halves with each."""
_STEPS = (0.0, 0.25, 0.5, -0.25, 0.75, -0.5, 1.0, -0.75, 1.25, -1.0)
"""By which the quality of an image may be another one than was asked for, the likely ones first (units of CRF)."""
_FAR_STEPS = (*(-quarter / 4 for quarter in range(25)), 0.25, 0.5, 0.75, 1.0)
"""The same where a keyframe comes so seldom that nothing before it is encoded again."""
_CLEAR = 0.75
"""Share of what is warned of, below which the quality that was asked for explains the images well enough."""
_SAME = 0.05
"""Of 255, mean square: images that differ by less are of one quality."""
_PAIR = 2
"""Frames that are compared from a keyframe on: one of each kind."""
_NEAR = 10
"""Keyframes around one that tell how much detail is usual."""
_LEAST_PIXELS, _MANY_PIXELS = 64, 1024
"""Of a colour in an image: one of fewer is not judged, one of many fully (four macroblocks of H.264, each of which has
one step of quality)."""
_LEVELS = 2.0
"""By which a block may be off beside its encoder's error: what rounding does."""
_LATER_WEIGHT = 0.7
"""Of the errors after the first keyframe's, where the encoder's quality may be a little another one."""
_WORST_SHARE = 0.3
"""Of its worst block's error an encoder may leave in any: at low quality a small thing's colour is lost, or is not."""
_ONE_STEP = 4.0
"""Levels by which a flat colour is off as a whole in an image of a little other quality."""
_DOUBTS, _COMMON = 2.0, 16.0
"""Standard errors of a displacement that may be chance, and how many pixels have the same of the encoder's errors."""
_DEPTH_METRES = 0.004
"""Depth is stored in millimetres; another machine draws edges a little elsewhere."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FullSize:
    """How N frames of a camera's colour images differ from what its encoder makes of the drawn ones.

    Attributes:
        frames: (N,) which they are.
        displacement: Pixels by which something is elsewhere: shift, and what turn, size, shear do half-way to a corner;
            less twice the standard error, which counts where images are small and coarsely encoded.
        sharpness: Pixels squared: half the variance of the blur that would make the difference; negative if sharpened.
        color: The mean difference of a colour, in units of its encoder's error (one level at least), the largest.
        color_frame: Where that is.
        errors: (N,) the image's error, of its worst block or of nine tenths of them, in units of the encoder's own;
            later ones weigh less.
        encoded: By how much the encoder makes the cells of an image unlike the drawn ones, root mean square, of 255.
    """

    frames: NDArray[np.int64]
    displacement: float
    sharpness: float
    color: float
    color_frame: int
    errors: Array
    encoded: float

    @property
    def is_clear(self) -> bool:
        """Whether all of them are well below what is warned of."""
        limits = limit_table()["checks"]
        found = {
            "image_placement": self.displacement,
            "image_sharpness": abs(self.sharpness),
            "image_colors": self.color,
            "image_errors": float(self.errors.max()),
        }
        return all(value < _CLEAR * limits[check]["warn"] for check, value in found.items())


def frames_to_compare(
    keyframes: NDArray[np.int64], count: int, detail: NDArray[np.float32] | None = None
) -> NDArray[np.int64]:
    """(N,) the first two frames, two later ones, and those around the keyframe whose detail is most unusual.

    Args:
        keyframes: In order.
        count: Frames that there are.
        detail: (count,) how much fine structure each image has; None where that is not known yet.
    """
    starts = keyframes[keyframes <= count - _PAIR]
    if not len(starts):
        return np.arange(min(count, _PAIR))
    chosen = [starts[0], starts[len(starts) // 2], starts[-1]]
    if detail is not None:
        amount = np.log(np.maximum(detail[starts], 1e-3))
        usual = np.array([np.median(amount[max(n - _NEAR, 0) : n + _NEAR + 1]) for n in range(len(starts))])
        chosen.append(starts[int(np.argmax(np.abs(amount - usual)))])
    chosen = np.unique(chosen)
    return np.asarray(np.unique((chosen[:, None] + np.arange(_PAIR)).reshape(-1)))


def with_lead(frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """The frames, and those before them that their encoder needs."""
    return np.asarray(np.unique(np.maximum(frames[:, None] - np.arange(LEAD + 1), 0)))


def _most_alike(
    settings: VideoSettings,
    config: VideoConfig,
    images: Sequence[Rgb],
    recorded: NDArray[np.uint8],
    steps: Sequence[float],
) -> Sequence[Rgb]:
    """What an encoder makes of the last of some images, at the quality that was asked for or one near it.

    Which it takes depends on all images before: x264 remembers how much they showed.

    Args:
        settings, config: Of the encoder.
        images: What it gets.
        recorded: (N, H, W, 3) what it made of the last N of them.
        steps: By which the quality may be another one.
    """
    best, least = list[Rgb](), np.inf
    for step in steps if config.codec == "h264" and config.crf is not None else steps[:1]:
        # A whole number to the user; x264 knows parts of it.
        other = replace(config, crf=max(config.crf + step, 0)) if step else config  # type: ignore[arg-type, operator]
        found = _encoded(settings, other, images, len(recorded))
        off = float(np.square(np.stack(found).astype(np.float32) - recorded).mean())
        if off < least:
            best, least = found, off
        if least < _SAME:
            break
    return best


def _encoded(settings: VideoSettings, config: VideoConfig, images: Sequence[Rgb], count: int) -> list[Rgb]:
    """What an encoder makes of the last `count` of some images."""
    encoder = make_encoder(config, settings.width, settings.height, settings.fps)
    data = [packet for image in images for packet in encoder.encode(image)]
    data += encoder.finish()
    # From the last keyframe on that they need.
    first = next((n for n in range(len(data) - count, 0, -1) if is_keyframe(config.codec, data[n])), 0)
    packets = [
        VideoPacket(frame_index=n, time_ns=0, data=data[n], is_keyframe=n == first) for n in range(first, len(data))
    ]
    return list(deque(decode(settings, packets), maxlen=count))


def compare_with_encoder(
    settings: VideoSettings, frames: NDArray[np.int64], seen: Mapping[int, Rgb], drawn: Mapping[int, Rgb]
) -> FullSize:
    """Compare some recorded frames with what their encoder makes of the drawn ones.

    Args:
        settings: Of the encoder.
        frames: (N,) as of `frames_to_compare`.
        seen: Frame -> recorded image, of those `with_lead`.
        drawn: Frame -> image.

    Raises:
        ConfigError: This build of FFmpeg lacks the encoder.
    """
    config = VideoConfig(
        codec=settings.codec,  # type: ignore[arg-type]
        gop=max(settings.gop, 1),
        crf=settings.crf,
        preset=settings.preset or None,
        jpeg_quality=settings.jpeg_quality or VideoConfig.jpeg_quality,
    )
    lead = LEAD // config.gop * config.gop  # so that the first of them is a keyframe as it was
    images, recorded = (np.stack([of[frame] for frame in frames.tolist()]) for of in (drawn, seen))
    for tries_qualities in (False, True):  # which takes long, and is seldom needed
        expected: list[Rgb] = []
        for part in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > 1) + 1):
            first = int(frames[part[0]])
            before = [seen[frame] for frame in range(max(first - lead, 0), first)]
            steps = (_STEPS if before else _FAR_STEPS) if tries_qualities else _STEPS[:1]
            expected += _most_alike(settings, config, [*before, *images[part]], recorded[part], steps)
        found = _compared(recorded, np.stack(expected), images, frames)
        if found.is_clear:
            break
    return found


def _compared(
    seen: NDArray[np.uint8], expected: NDArray[np.uint8], drawn: NDArray[np.uint8], frames: NDArray[np.int64]
) -> FullSize:
    """Compare images (N, H, W, 3): recorded, encoded again, and drawn."""
    from demorec.check import kernels

    count, height, width, _ = drawn.shape
    reach = min(height, width) / 4
    all_of = np.zeros((8, 8))
    used = kernels.full_size_equations(seen, expected, drawn, all_of)
    gram, right = all_of[:7, :7], all_of[:7, 7]
    covariance = np.linalg.inv(gram + np.eye(7) * max(1e-6 * float(np.trace(gram)) / 7, 1e-9))
    moved = covariance @ right
    left = max(float(all_of[7, 7] - moved @ right), 0.0) * _COMMON / max(used, 1)  # mean square of what is left
    doubt = np.sqrt(left * np.diag(covariance))
    colors = np.zeros((count, 64, 7))
    kernels.sum_colors_off(seen, expected, drawn, colors)
    off, own = np.zeros((count, height // BLOCK, width // BLOCK)), np.zeros((count, height // BLOCK, width // BLOCK))
    kernels.block_errors(seen, expected, drawn, BLOCK, off, own)
    color, frame = _worst_color(colors)
    grid = CellGrid(width, height)
    cells = [np.stack([grid.read("color", image).cells for image in images]) for images in (expected, drawn)]
    return FullSize(
        frames=frames,
        displacement=max(_displacement(moved, reach) - _DOUBTS * _displacement(doubt, reach), 0.0),
        sharpness=float(moved[6]),
        color=color,
        color_frame=int(frames[frame]),
        errors=np.array([_error(*pair) for pair in zip(off, own, strict=True)])
        * np.where(frames < frames[0] + _PAIR, 1.0, _LATER_WEIGHT),
        encoded=float(np.sqrt(np.mean((cells[0] - cells[1]) ** 2))),
    )


def _displacement(moved: Array, reach: float) -> float:
    return float(np.hypot(*moved[:2]) + np.abs(moved[2:6]).max() * reach)


def _worst_color(sums: Array) -> tuple[float, int]:
    """The largest mean difference of a colour, and the image's number; of (N, 64, 7): pixels, differences, squares.

    Over all images, and in each at half its weight: there the encoder's quality may be a little another one.
    """
    each = _ratio(sums, sums[..., :1], least=_ONE_STEP) / 2
    number = int(np.argmax(each))
    # What stands still is encoded alike in all of them: more images are no more blocks.
    most = sums[..., :1].max(axis=0, keepdims=True)
    return max(float(_ratio(sums.sum(axis=0, keepdims=True), most, least=1.0)[0]), float(each[number])), number


def _ratio(sums: Array, different: Array, *, least: float) -> Array:
    """(N,) of each image the largest of any colour, in units of the encoder's error.

    Args:
        sums: (N, 64, 7) as of `_worst_color`.
        different: (N, 64, 1) how many pixels of the colour are not those of another image once more.
        least: Levels that the encoder's error counts at least.
    """
    pixels = np.maximum(sums[..., :1], 1)
    mean = np.abs(sums[..., 1:4]) / pixels
    own = np.sqrt(sums[..., 4:] / pixels)
    # Of a few blocks the encoder's errors do not cancel.
    weight = np.minimum(np.sqrt(different / _MANY_PIXELS), 1.0) * (different >= _LEAST_PIXELS)
    return np.asarray((mean / np.maximum(own, least) * weight).max(axis=(1, 2)))


def _error(off: Array, own: Array) -> float:
    """Of the blocks (h, w) of one image: its worst, or nine tenths of them, against the largest of the encoder's there,
    on both sides and below (of the last row: above)."""
    around = own.copy()
    around[1:] = np.maximum(own[1:], own[:-1])
    around[:-1] = np.maximum(own[:-1], own[1:])
    wide = around.copy()
    wide[:, 1:] = np.maximum(wide[:, 1:], around[:, :-1])
    wide[:, :-1] = np.maximum(wide[:, :-1], around[:, 1:])
    least = max(_WORST_SHARE * float(own.max(initial=0.0)), 0.5)
    worst = float(((off - _LEVELS) / np.maximum(wide, least)).max(initial=0.0))
    usual = float(np.quantile(off / np.maximum(own, 1.0), 0.9)) if off.size else 0.0
    return max(worst, usual)


def share_off(seen: NDArray[Any], drawn: NDArray[Any]) -> float:
    """Of depth (H, W) in metres, or labels: the share of pixels that are others than drawn."""
    off = np.abs(seen - drawn) > _DEPTH_METRES if seen.dtype.kind == "f" else seen != drawn
    return float(off.mean())

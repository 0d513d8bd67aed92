"""What `demorec check` finds of faults in images, depth and labels that are in no test.

    python benchmarks/image_faults.py --half a            # the half that limits may be set by
    python benchmarks/image_faults.py --half b            # the half that is measured, and not looked at before
    python benchmarks/image_faults.py --half a --settings 2 --verbose

Good episodes of several tasks, arms, sizes, rates and codecs are recorded. Each fault is put into the images as they
were drawn, before they are encoded once, as a faulty camera or renderer would, and the histograms are counted of what
came out; depth and labels are changed as they are. A fault is found when a check of images fails, seen when one warns.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from check_limits import record
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter
from scipy import ndimage

from demorec.check.base import Form, Result
from demorec.check.episode import CheckedEpisode
from demorec.check.episode_drawn import drawable_scene
from demorec.check.films import Film, likeness_of_films, parts_of
from demorec.check.report import CheckOptions
from demorec.core.config import GenerateConfig, VideoConfig
from demorec.core.tables import CHECKS
from demorec.mcap.images import PixelCounter
from demorec.mcap.video import VideoPacket, VideoSettings, decode, make_encoder
from demorec.render.painter import Painter
from demorec.render.raster import RasterRenderer
from demorec.render.recorded import RecordedWorld

Rows = NDArray[Any]
Fault = Callable[[Rows], Rows]

SETTINGS = (
    GenerateConfig(task="pick_place", width=160, height=160, fps=10, depth=True, segmentation=True),
    GenerateConfig(task="stack", robot="iiwa", variation="full", width=96, height=96, fps=10, depth=True,
                   segmentation=True, video=VideoConfig(crf=28)),
    GenerateConfig(task="tutorial", variation="full", width=192, height=144, fps=10, video=VideoConfig(codec="av1")),
)  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- helpers


def clipped(values: Rows) -> Rows:
    """As bytes."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def each(change: Callable[[Image.Image], Image.Image]) -> Fault:
    """A change of every image by Pillow."""
    return lambda rows: np.stack([np.asarray(change(Image.fromarray(row)).convert("RGB")) for row in rows])


def moved(right: float, down: float) -> Fault:
    """Shifted by parts of a pixel."""
    return lambda rows: clipped(ndimage.shift(rows.astype(np.float32), (0, down, right, 0), order=1, mode="nearest"))


def warped(matrix: Sequence[float]) -> Fault:
    """About the middle: a, b, c, d, in pixels of the source."""
    a, b, c, d = matrix

    def change(image: Image.Image) -> Image.Image:
        x, y = (image.width - 1) / 2, (image.height - 1) / 2
        values = (a, b, x - a * x - b * y, c, d, y - c * x - d * y)
        return image.transform(image.size, Image.Transform.AFFINE, values, Image.Resampling.BICUBIC)

    return each(change)


def noise(sigma: float) -> Fault:
    """Of a normal distribution, another one in each frame."""
    return lambda rows: clipped(rows + np.random.default_rng(1).normal(0, sigma, rows.shape).astype(np.float32))


def matrix(values: Sequence[Sequence[float]]) -> Fault:
    """Colours through a matrix."""
    return lambda rows: clipped(rows.astype(np.float32) @ np.array(values, dtype=np.float32).T)


def saturated(share: float) -> Fault:
    """Colours farther from grey, or nearer."""
    grey = np.array([0.299, 0.587, 0.114])
    return matrix((share * np.eye(3) + (1 - share) * np.tile(grey, (3, 1))).tolist())


def wrong_matrix() -> Fault:
    """Encoded by BT.601, decoded as if it were BT.709."""

    def yuv(red: float, blue: float) -> Rows:
        green = 1 - red - blue
        y = np.array([red, green, blue])
        return np.stack([y, (np.array([0, 0, 1]) - y) / (2 - 2 * blue), (np.array([1, 0, 0]) - y) / (2 - 2 * red)])

    return matrix((np.linalg.inv(yuv(0.2126, 0.0722)) @ yuv(0.299, 0.114)).tolist())


def curve(change: Callable[[Rows], Rows]) -> Fault:
    """Of each channel, 0 to 1."""
    return lambda rows: clipped(255 * change(rows.astype(np.float32) / 255))


def place(rows: Rows, x: float, y: float, size: int) -> tuple[slice, slice, slice]:
    """Of a square, in shares of the width and height."""
    top, left = int(y * (rows.shape[1] - size)), int(x * (rows.shape[2] - size))
    return slice(None), slice(top, top + size), slice(left, left + size)


def patch(x: float, y: float, size: int, change: Fault) -> Fault:
    """A change of one square."""

    def fault(rows: Rows) -> Rows:
        out, where = rows.copy(), place(rows, x, y, size)
        out[where] = change(rows[where])
        return out

    return fault


def middle(count: int, change: Fault) -> Fault:
    """A change of so many frames in the middle."""

    def fault(rows: Rows) -> Rows:
        first = len(rows) // 2
        return np.concatenate([rows[:first], change(rows[first : first + count]), rows[first + count :]])

    return fault


def over_time(gain: Callable[[Rows], Rows]) -> Fault:
    """Gains (T,) or (T, 3) over time 0 to 1."""

    def fault(rows: Rows) -> Rows:
        gains = np.asarray(gain(np.linspace(0, 1, len(rows))), dtype=np.float32).reshape(len(rows), 1, 1, -1)
        return clipped(rows * gains)

    return fault


def small_and_back(share: float, resample: Image.Resampling) -> Fault:
    """Resized and resized back."""
    return each(
        lambda image: image.resize((round(image.width * share), round(image.height * share)), resample).resize(
            image.size, resample
        )
    )


def distorted(strength: float) -> Fault:
    """As a lens would."""

    def fault(rows: Rows) -> Rows:
        height, width = rows.shape[1:3]
        y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
        factor = 1 + strength * (x * x + y * y)
        places = [(y * factor + 1) / 2 * (height - 1), (x * factor + 1) / 2 * (width - 1)]
        return np.stack(
            [
                np.stack([ndimage.map_coordinates(row[..., c], places, order=1, mode="nearest") for c in range(3)], -1)
                for row in rows
            ]
        )

    return fault


def rolling(rows: Rows) -> Rows:
    """Lower rows are of up to one frame before."""
    share = np.linspace(0, 1, rows.shape[1], dtype=np.float32)[None, :, None, None]
    before = np.concatenate([rows[:1], rows[:-1]])
    return clipped((1 - share) * rows + share * before)


def with_text(image: Image.Image) -> Image.Image:
    """A stamp in the corner."""
    image = image.copy()
    ImageDraw.Draw(image).text((2, 1), "12:03", fill="white")
    return image


def chroma_moved(rows: Rows) -> Rows:
    """Chroma one pixel to the right of the luma."""
    parts = [np.asarray(Image.fromarray(row).convert("YCbCr")) for row in rows]
    for part in parts:
        assert part.shape[2] == 3
    moved_parts = [np.concatenate([p[..., :1], np.roll(p[..., 1:], 1, axis=1)], axis=2) for p in parts]
    return np.stack([np.asarray(Image.fromarray(p, "YCbCr").convert("RGB")) for p in moved_parts])


def one_channel_moved(rows: Rows) -> Rows:
    out = rows.copy()
    out[..., 0] = np.roll(rows[..., 0], 1, axis=2)
    return out


def lines(axis: int, value: int) -> Fault:
    """One dead line."""

    def fault(rows: Rows) -> Rows:
        out = rows.copy()
        index = [slice(None)] * 4
        index[axis] = slice(rows.shape[axis] // 3, rows.shape[axis] // 3 + 1)
        out[tuple(index)] = value
        return out

    return fault


def jpeg(quality: int) -> Fault:
    """Encoded as JPEG before."""
    import io

    def change(image: Image.Image) -> Image.Image:
        buffer = io.BytesIO()
        image.save(buffer, "JPEG", quality=quality)
        return Image.open(io.BytesIO(buffer.getvalue()))

    return each(change)


def mosaic(rows: Rows) -> Rows:
    """Blocks of 8x8 of one colour."""
    height, width = (size // 8 * 8 for size in rows.shape[1:3])
    out = rows.copy()
    blocks = rows[:, :height, :width].reshape(len(rows), height // 8, 8, width // 8, 8, 3).mean(axis=(2, 4))
    out[:, :height, :width] = clipped(blocks).repeat(8, axis=1).repeat(8, axis=2)
    return out


def black_border(rows: Rows) -> Rows:
    out = np.zeros_like(rows)
    out[:, 2:-2, 2:-2] = rows[:, 2:-2, 2:-2]
    return out


def vignette(rows: Rows) -> Rows:
    height, width = rows.shape[1:3]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return clipped(rows * (1 - 0.1 * (x * x + y * y)).astype(np.float32)[None, :, :, None])


def striped(rows: Rows) -> Rows:
    stripes = 3 * np.sin(np.arange(rows.shape[2]) * 2 * np.pi / 12)
    return clipped(rows + stripes[None, None, :, None].astype(np.float32))


def interlaced(rows: Rows) -> Rows:
    out = rows.copy()
    out[1:, 1::2] = rows[:-1, 1::2]
    return out


def before(share: float, frames: int = 1) -> Fault:
    """Mixed with the frame before."""

    def fault(rows: Rows) -> Rows:
        late = np.concatenate([rows[:frames], rows[:-frames]])
        return clipped((1 - share) * rows.astype(np.float32) + share * late)

    return fault


def salt(rows: Rows) -> Rows:
    out, draws = rows.copy(), np.random.default_rng(2).random(rows.shape[:3])
    out[draws < 5e-4], out[draws > 1 - 5e-4] = 0, 255
    return out


def overlaid(rows: Rows) -> Rows:
    return clipped(0.8 * rows.astype(np.float32) + 0.2 * 255)


IDENTITY: Fault = lambda rows: rows.copy()  # noqa: E731
RADIUS = ImageFilter.GaussianBlur

COLOR: dict[str, Fault] = {
    "blurred by 0.6 px": each(lambda image: image.filter(RADIUS(0.6))),
    "blurred by 1 px": each(lambda image: image.filter(RADIUS(1.0))),
    "sharpened": each(lambda image: image.filter(ImageFilter.UnsharpMask(1, 60, 0))),
    "sharpened a little": each(lambda image: image.filter(ImageFilter.UnsharpMask(1, 30, 0))),
    "noise of 5 levels": noise(5.0),
    "noise of 8 levels": noise(8.0),
    "salt and pepper": salt,
    "every second row of the frame before": interlaced,
    "half a pixel to the right": moved(0.5, 0.0),
    "half a pixel down": moved(0.0, 0.5),
    "half a pixel to the left and up": moved(-0.5, -0.5),
    "chroma a pixel to the right": chroma_moved,
    "red a pixel to the right": one_channel_moved,
    "turned by half a degree": warped((1.0, 0.0087, -0.0087, 1.0)),
    "zoomed by half a percent": warped((0.995, 0.0, 0.0, 0.995)),
    "three percent too wide": warped((0.97, 0.0, 0.0, 1.0)),
    "a lens's distortion of 2 %": distorted(0.02),
    "sheared by one percent": warped((1.0, 0.01, 0.0, 1.0)),
    "a dark spot of 5 px": patch(0.3, 0.7, 5, lambda part: part // 3),
    "a smudge of 15 px": patch(0.6, 0.6, 15, lambda p: clipped(0.85 * p.mean(axis=(1, 2), keepdims=True) + 0 * p)),
    "a dead column": lines(2, 0),
    "a bright row": lines(1, 255),
    "a hot pixel": patch(0.5, 0.4, 1, lambda part: part * 0 + 255),
    "a black border of 2 px": black_border,
    "the time in the corner": each(with_text),
    "a semi-transparent logo": patch(0.9, 0.1, 20, overlaid),
    "a grey square of 32 px": patch(0.2, 0.8, 32, lambda part: clipped(part.mean(axis=3, keepdims=True) + 0 * part)),
    "a mosaic in a part": patch(0.5, 0.7, 32, mosaic),
    "posterised to 32 levels": lambda rows: (rows // 8 * 8 + 4).astype(np.uint8),
    "posterised to 16 levels": lambda rows: (rows // 16 * 16 + 8).astype(np.uint8),
    "less saturated by 15 %": saturated(0.85),
    "more saturated by 15 %": saturated(1.15),
    "BT.709 for BT.601": wrong_matrix(),
    "hue turned": matrix(((0.97, 0.06, -0.03), (-0.03, 0.97, 0.06), (0.06, -0.03, 0.97))),
    "full for limited range": curve(lambda x: (x - 16 / 255) * 255 / 219),
    "limited for full range": curve(lambda x: 16 / 255 + x * 219 / 255),
    "gamma 1.1": curve(lambda x: np.power(x, 1.1)),
    "gamma 0.9": curve(lambda x: np.power(x, 0.9)),
    "six levels brighter": lambda rows: clipped(rows.astype(np.float32) + 6),
    "red by 5 % brighter": matrix(((1.05, 0, 0), (0, 1, 0), (0, 0, 1))),
    "blue by 5 % darker": matrix(((1, 0, 0), (0, 1, 0), (0, 0, 0.95))),
    "blacks crushed": curve(lambda x: np.where(x < 0.2, 0.5 * x, x)),
    "highlights clipped": curve(lambda x: np.minimum(x, 0.75)),
    "a vignette": vignette,
    "stripes of 3 levels": striped,
    "JPEG of quality 30 before": jpeg(30),
    "JPEG of quality 60 before": jpeg(60),
    "half the size and back": small_and_back(0.5, Image.Resampling.BILINEAR),
    "three quarters and back, nearest": small_and_back(0.75, Image.Resampling.NEAREST),
    "encoded twice": IDENTITY,
    "a third of the frame before": before(0.33),
    "a ghost of three frames before": before(0.2, 3),
    "a rolling shutter": rolling,
    "exposure drifts": over_time(lambda t: 1 + 0.08 * np.sin(2 * np.pi * t)),
    "white balance drifts": over_time(lambda t: np.stack([1 + 0.08 * t, 1 + 0 * t, 1 - 0.08 * t], axis=1)),
    "every second frame brighter by 4 %": over_time(lambda t: 1 + 0.04 * (np.arange(len(t)) % 2)),
    "15 frames blurred": middle(15, each(lambda image: image.filter(RADIUS(1.2)))),
    "15 frames noisy": middle(15, noise(8.0)),
    "15 frames grey": middle(15, saturated(0.5)),
    "15 frames mosaic": middle(15, mosaic),
}  # fmt: skip


def quantised(step: float) -> Fault:
    return lambda rows: np.where(rows > 0, np.round(rows / step) * step, rows).astype(np.float32)


def holes(rows: Rows) -> Rows:
    out = rows.copy()
    out[np.random.default_rng(3).random(rows.shape) < 0.02] = 0
    return out


def grown(pixels: int, axes: tuple[int, int] = (1, 2)) -> Fault:
    """What is nearer, wider by so many pixels."""
    size = [1, 1, 1]
    for axis in axes:
        size[axis] = 2 * pixels + 1
    return lambda rows: ndimage.minimum_filter(rows, size=size)


def noisy_depth(rows: Rows) -> Rows:
    return (rows + np.random.default_rng(4).normal(0, 0.01, rows.shape)).astype(np.float32)


def tilted(rows: Rows) -> Rows:
    return np.asarray(rows + np.linspace(-0.01, 0.01, rows.shape[2])[None, None], dtype=np.float32)


def half_size(rows: Rows) -> Rows:
    return np.asarray(rows[:, ::2, ::2].repeat(2, axis=1).repeat(2, axis=2)[:, : rows.shape[1], : rows.shape[2]])


def mixed(rows: Rows) -> Rows:
    late = np.concatenate([rows[:1], rows[:-1]])
    return np.asarray((rows + late) / 2, dtype=np.float32)


DEPTH: dict[str, Fault] = {
    "2 cm too far": lambda rows: (rows + np.float32(0.02)).astype(np.float32),
    "1 cm too near": lambda rows: (rows - np.float32(0.01)).astype(np.float32),
    "8 bit": quantised(3 / 255),
    "steps of 1 cm": quantised(0.01),
    "8 px to the right": lambda rows: np.roll(rows, 8, axis=2),
    "2 px down": lambda rows: np.roll(rows, 2, axis=1),
    "1 px to the left": lambda rows: np.roll(rows, -1, axis=2),
    "3 % too far": lambda rows: rows * np.float32(1.03),
    "1 % too near": lambda rows: rows * np.float32(0.99),
    "noise of 1 cm": noisy_depth,
    "2 % of holes": holes,
    "edges smeared": lambda rows: np.stack([ndimage.gaussian_filter(row, 1.0) for row in rows]),
    "tilted by 1 cm": tilted,
    "cut off at 1 m": lambda rows: np.minimum(rows, np.float32(1.0)),
    "foreground grown by 2 px": grown(2),
    "half the size": half_size,
    "mixed with the frame before": mixed,
    "median of 5 px": lambda rows: np.stack([ndimage.median_filter(row, 5) for row in rows]),
}


def labels_grown(pixels: int) -> Fault:
    """Movable and robot bodies (the larger numbers) wider by so many pixels."""
    return lambda rows: ndimage.maximum_filter(rows, size=(1, 2 * pixels + 1, 2 * pixels + 1))


def one_gone(rows: Rows) -> Rows:
    values, counts = np.unique(rows, return_counts=True)
    smallest = values[np.argsort(counts)][len(values) // 2]
    table = int(values[np.argmax(counts)])
    return np.where(rows == smallest, table, rows).astype(rows.dtype)


def label_holes(rows: Rows) -> Rows:
    return np.where(np.random.default_rng(5).random(rows.shape) < 0.01, -1, rows).astype(rows.dtype)


LABELS: dict[str, Fault] = {
    "grown by 2 px": labels_grown(2),
    "grown by 1 px": labels_grown(1),
    "shrunk by 1 px": lambda rows: ndimage.minimum_filter(rows, size=(1, 3, 3)),
    "median of 5 px": lambda rows: np.stack([ndimage.median_filter(row, 5) for row in rows]),
    "half the size": half_size,
    "one body missing": one_gone,
    "1 px to the right": lambda rows: np.roll(rows, 1, axis=2),
    "2 px up": lambda rows: np.roll(rows, -2, axis=1),
    "1 % of holes": label_holes,
    "two frames late": lambda rows: np.concatenate([rows[:2], rows[:-2]]),
}

FAULTS: list[tuple[str, str, Fault]] = [
    *(("color", name, fault) for name, fault in COLOR.items()),
    *(("depth", name, fault) for name, fault in DEPTH.items()),
    *(("labels", name, fault) for name, fault in LABELS.items()),
]


# --------------------------------------------------------------------------- of recordings whose scene nobody knows


Reel = dict[str, Rows]
"""Camera -> (T, H, W, 3)."""


def of_one(change: Fault) -> Callable[[Reel], Reel]:
    """A change of the first camera's images."""

    def fault(reel: Reel) -> Reel:
        first = next(iter(reel))
        return {**reel, first: change(reel[first])}

    return fault


def changed_places(since: float, until: float = 1.0) -> Callable[[Reel], Reel]:
    """The first two cameras, for a share of the episode."""

    def fault(reel: Reel) -> Reel:
        (one, a), (other, b) = list(reel.items())[:2]
        rows = slice(int(since * len(a)), int(until * len(a)))
        a, b = a.copy(), b.copy()
        a[rows], b[rows] = reel[other][rows], reel[one][rows]
        return {**reel, one: a, other: b}

    return fault


def hangs(seconds: float, fps: int = 10) -> Fault:
    """One image for so long, from the first third on."""

    def fault(rows: Rows) -> Rows:
        out, first = rows.copy(), len(rows) // 3
        out[first : first + round(seconds * fps)] = rows[first]
        return out

    return fault


def alien(rows: Rows) -> Rows:
    """One image of another moment."""
    out = rows.copy()
    out[len(rows) // 2] = rows[3]
    return out


def empty(rows: Rows) -> Rows:
    """One image is black."""
    out = rows.copy()
    out[len(rows) // 4] = 0
    return out


def shifted(frames: int) -> Fault:
    """So many frames late, or early."""
    return lambda rows: (
        np.concatenate([np.repeat(rows[:1], frames, axis=0), rows[:-frames]])
        if frames > 0
        else (np.concatenate([rows[-frames:], np.repeat(rows[-1:], -frames, axis=0)]))
    )


OTHERS: dict[str, Callable[[Reel], Reel]] = {
    "cameras change places in the middle": changed_places(0.5),
    "cameras change places for a tenth": changed_places(0.7, 0.8),
    "cameras change places near the end": changed_places(0.9),
    "one camera twice": lambda reel: {name: reel[next(iter(reel))] for name in reel},
    "a camera hangs for 2 s": of_one(hangs(2.0)),
    "a camera hangs for 1 s": of_one(hangs(1.0)),
    "a camera hangs from the middle on": of_one(lambda rows: np.concatenate([rows[: len(rows) // 2], np.repeat(
        rows[len(rows) // 2 :][:1], len(rows) - len(rows) // 2, axis=0)])),
    "an image of another moment": of_one(alien),
    "a black image": of_one(empty),
    "a covered camera": of_one(lambda rows: (rows // 255).astype(np.uint8)),
    "backwards": of_one(lambda rows: rows[::-1].copy()),
    "six frames late": of_one(shifted(6)),
    "six frames early": of_one(shifted(-6)),
    "five frames late": of_one(shifted(5)),
    "exposure drifts by 15 %": of_one(over_time(lambda t: 1 - 0.15 * t)),
    "exposure drifts by 10 %": of_one(over_time(lambda t: 0.9 + 0.1 * t)),
    "exposure hunts": of_one(over_time(lambda t: 1 + 0.06 * np.sin(20 * t))),
    "white balance drifts": of_one(over_time(lambda t: np.stack([1 - 0.1 * t, 1 - 0 * t, 0.9 + 0.1 * t], axis=1))),
    "exposure jumps by 8 %": of_one(over_time(lambda t: np.where(t > 0.6, 0.92, 1.0))),
    "white balance jumps": of_one(over_time(lambda t: np.where(t[:, None] > 0.4, [0.9, 1.0, 1.0], 1.0))),
}  # fmt: skip


class Stranger:
    """What is left of an episode without its scene: images beside states."""

    form: ClassVar[Form] = "external"

    def __init__(self, reel: Reel, state: Rows, fps: int) -> None:
        frames = np.arange(len(state))
        self.films = {
            name: [Film(where=name, fps=fps, cells=cells, detail=detail, frames=frames, state=state)]
            for name, (cells, detail) in ((name, parts_of(rows)) for name, rows in reel.items())
        }

    def likeness_of_cameras(self) -> Iterator[tuple[str, float]]:
        """As of an external recording."""
        return likeness_of_films(self.films)

    def distances(self) -> tuple[()]:
        """Of no depth camera."""
        return ()


def judge_stranger(subject: Stranger) -> list[Result]:
    """What the laws of images over time say."""
    names = [
        name for name in CHECKS.names() if CHECKS.load(name).measure.__module__.endswith((".over_time", ".repeats"))
    ]
    return [CHECKS.load(name).run(subject) for name in (*names, "images_show_something", "distinct_cameras")]


def levels_of(name: str, results: Sequence[Result], total: dict[str, int], *, verbose: bool) -> None:
    """Count and tell what was found of a fault."""
    failed = [r.check for r in results if r.level == "fail"]
    warned = [r.check for r in results if r.level == "warn"]
    level = "found" if failed else "seen" if warned else "missed"
    total[level] += 1
    if verbose or level != "found":
        print(f"  {level:7}{name}: {', '.join(failed or warned)}", flush=True)


# ------------------------------------------------------------------------------------------------------------- measure


def drawn_images(episode: CheckedEpisode) -> dict[str, Rows]:
    """Camera -> (T, H, W, 3) as they were before they were encoded."""
    info, columns = episode.info, episode.columns
    scene = drawable_scene(info)
    joints, objects = columns.joint_position, columns.object_poses
    world = RecordedWorld(info.robot, scene, joint_position=joints, object_poses=objects)
    images: dict[str, list[Rows]] = {camera.name: [] for camera in scene.cameras}
    with RasterRenderer() as renderer:
        painter = Painter(renderer, scene.cameras)
        painter.setup(world)
        for world.frame in range(columns.num_frames):
            for name, image in painter.images().items():
                images[name].append(image.color.copy())
    return {name: np.stack(rows) for name, rows in images.items()}


def encoded(settings: VideoSettings, images: Rows, *, times: int = 1) -> tuple[list[VideoPacket], Rows]:
    """Packets of images, and what they show."""
    quality = {} if settings.jpeg_quality is None else {"jpeg_quality": settings.jpeg_quality}
    config = VideoConfig(codec=settings.codec, gop=max(settings.gop, 1), crf=settings.crf, **quality)  # type: ignore[arg-type]
    for _ in range(times):
        encoder = make_encoder(config, settings.width, settings.height, settings.fps)
        data = [packet for image in images for packet in encoder.encode(np.ascontiguousarray(image))]
        data += encoder.finish()
        packets = [
            VideoPacket(frame_index=n, time_ns=0, data=packet, is_keyframe=n % max(settings.gop, 1) == 0)
            for n, packet in enumerate(data)
        ]
        images = np.stack(list(decode(settings, packets)))
    return packets, images


def judge(path: Path, changed: Mapping[tuple[str, str], Rows], *, times: int = 1) -> list[Result]:
    """What the checks of images say of a recording with other images."""
    with CheckedEpisode(path) as episode:
        recording: Any = episode.recording
        reads = {"color": recording.images, "depth": recording.depth, "labels": recording.segmentation}
        counted: dict[str, Any] = {}
        packets_of = recording.packets
        packets: dict[str, list[VideoPacket]] = {}
        images: dict[tuple[str, str], Rows] = dict(changed)
        images_at = recording.images_at
        for (camera, kind), rows in changed.items():
            if kind == "color":
                packets[camera], images[camera, kind] = encoded(recording.video_settings(camera), rows, times=times)
                counter = PixelCounter()
                for row in rows:
                    counter.add(np.ascontiguousarray(row))
                counted[camera] = counter.statistics()
        statistics = recording.pixel_statistics
        recording.pixel_statistics = lambda camera: counted.get(camera) or statistics(camera)
        recording.packets = lambda camera: iter(packets[camera]) if camera in packets else packets_of(camera)
        recording.images_at = lambda camera, frames: (
            iter(images[camera, "color"][list(frames)]) if (camera, "color") in images else images_at(camera, frames)
        )
        for kind, name in (("color", "images"), ("depth", "depth"), ("labels", "segmentation")):

            def read(camera: str, kind: str = kind) -> Iterator[Rows]:
                return iter(images[camera, kind]) if (camera, kind) in images else reads[kind](camera)

            setattr(recording, name, read)
        checks = [check for check in CheckOptions().checks("simulated") if check.needs_images]
        return [check.run(episode) for check in checks]


def main() -> None:
    """Record, spoil, tell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--half", choices=("a", "b", "both"), default="a")
    parser.add_argument("--settings", type=int, default=len(SETTINGS), help="so many of the settings")
    parser.add_argument("--only", default="", help="faults whose name has this in it")
    parser.add_argument("--cache", type=Path, help="a folder that keeps the recordings")
    parser.add_argument("--verbose", action="store_true", help="tell what was found of each")
    options = parser.parse_args()
    chosen = [
        fault
        for number, fault in enumerate(FAULTS)
        if options.half in ("both", "ab"[number % 2]) and options.only in fault[1]
    ]
    total, others = ({"found": 0, "seen": 0, "missed": 0} for _ in range(2))
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.cache or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for number, config in enumerate(SETTINGS[: options.settings]):
            path = folder / f"fault_{number}.mcap"
            if not path.exists() and not record(config, 3, path):
                raise SystemExit(f"The episode of setting {number} fails.")
            with CheckedEpisode(path) as episode:
                cameras = [camera.name for camera in episode.cameras]
                good = {(camera, "color"): rows for camera, rows in drawn_images(episode).items()}
                if episode.recording.has_depth(cameras[0]):
                    good |= {(name, "depth"): np.stack(list(episode.recording.depth(name))) for name in cameras}
                    good |= {(name, "labels"): np.stack(list(episode.recording.segmentation(name))) for name in cameras}
            clean = [r for r in judge(path, {}) if r.level in ("warn", "fail")]
            told = (
                f"{config.task} {config.robot} {config.variation} {config.width}x{config.height} {config.video.codec}"
            )
            print(f"{told}: clean: {', '.join(r.check for r in clean) or 'passes'}", flush=True)
            for turn, (kind, name, fault) in enumerate(chosen):
                key = (cameras[turn % len(cameras)], kind)
                if key not in good:
                    continue
                changed = fault(good[key])
                assert fault is IDENTITY or not np.array_equal(changed, good[key]), name
                results = judge(path, {key: changed}, times=1 + (fault is IDENTITY))
                levels_of(f"{key[0]} {kind} {name}", results, total, verbose=options.verbose)
            with CheckedEpisode(path) as episode:
                columns, fps = episode.columns, episode.info.fps
                state = np.column_stack([columns.joint_position[:, : episode.num_arm], columns.gripper_width])
            reel = {camera: good[camera, "color"] for camera in cameras}
            clean = [r for r in judge_stranger(Stranger(reel, state, fps)) if r.level in ("warn", "fail")]
            print(f"without a scene: clean: {', '.join(r.check for r in clean) or 'passes'}", flush=True)
            for turn, (name, spoil) in enumerate(OTHERS.items()):
                if options.half in ("both", "ab"[turn % 2]) and options.only in name:
                    subject = Stranger(spoil(reel), state, fps)
                    levels_of(name, judge_stranger(subject), others, verbose=options.verbose)
    print(f"{sum(total.values())} faults: {total}; without a scene {sum(others.values())}: {others}")


if __name__ == "__main__":
    main()

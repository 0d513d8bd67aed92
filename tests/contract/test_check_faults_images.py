"""Faults of images, depth and labels, each caught by the check that compares them with what the numbers make of them.

The images of a good recording are decoded once and changed in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from PIL import Image, ImageFilter
from scipy import ndimage
from support.check import checked, simulate
from support.faults import Good, Rows

from demorec.check.cells import ImageKind
from demorec.check.drawn import ImageComparison, fill_between, frames_to_draw
from demorec.check.episode import CheckedEpisode
from demorec.check.episode_drawn import DrawnEpisode
from demorec.core.geometry import Array
from demorec.core.tables import CHECKS
from demorec.render.recorded import RecordedWorld

pytestmark = pytest.mark.slow

Fault = Callable[[Rows], Rows]
RANDOM = np.random.default_rng(1)
ONE = 100
"""The frame of a single odd image: the hand is closing in on the cube."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Good:
    """One pick-and-place by an iiwa, whose orange is nearly the cube's red, with all kinds of images."""
    path = tmp_path_factory.mktemp("good") / "good.mcap"
    return Good.open(simulate(path, seed=5, robot="iiwa", cameras=("front", "wrist"), depth=True, segmentation=True))


def one(change: Fault) -> Fault:
    """The change at one frame."""

    def fault(rows: Rows) -> Rows:
        out = rows.copy()
        out[ONE] = change(rows[ONE : ONE + 1])[0]
        return out

    return fault


def late(frames: int) -> Fault:
    return lambda rows: np.concatenate([np.repeat(rows[:1], frames, axis=0), rows[:-frames]])


def early(rows: Rows) -> Rows:
    return np.concatenate([rows[1:], rows[-1:]])


def rolled(pixels: int, axis: int = 2) -> Fault:
    return lambda rows: np.roll(rows, pixels, axis=axis)


def blurred(rows: Rows) -> Rows:
    return np.stack([np.asarray(Image.fromarray(row).filter(ImageFilter.GaussianBlur(3))) for row in rows])


def greenish(rows: Rows) -> Rows:
    out = rows.copy()
    out[..., 1] = np.minimum(rows[..., 1].astype(int) + 60, 255)
    return out


def torn(rows: Rows) -> Rows:
    out = rows.copy()
    out[ONE, rows.shape[1] // 2 :] = rows[ONE - 60, rows.shape[1] // 2 :]
    return out


def of_frame(frame: int) -> Fault:
    def fault(rows: Rows) -> Rows:
        out = rows.copy()
        out[ONE] = rows[frame]
        return out

    return fault


def stuck(first: int, last: int) -> Fault:
    def fault(rows: Rows) -> Rows:
        out = rows.copy()
        out[first:last] = rows[first]
        return out

    return fault


def every_other_twice(rows: Rows) -> Rows:
    return np.asarray(rows[(np.arange(len(rows)) // 2) * 2])


def darker(rows: Rows) -> Rows:
    return np.asarray(rows * 0.75, dtype=rows.dtype)


def grey(rows: Rows) -> Rows:
    return np.asarray(np.repeat(rows.mean(axis=3, keepdims=True), 3, axis=3), dtype=rows.dtype)


def zoomed(times: float) -> Fault:
    def fault(rows: Rows) -> Rows:
        height, width = rows.shape[1:3]
        x, y = (size / 2 * (1 - 1 / times) for size in (width, height))
        box = (x, y, width - x, height - y)
        resize = Image.Resampling.BILINEAR
        return np.stack([np.asarray(Image.fromarray(row).resize((width, height), resize, box=box)) for row in rows])

    return fault


def swapped_labels(rows: Rows) -> Rows:
    out = rows.copy()
    values = [value for value in np.unique(rows) if value >= 0]
    out[rows == values[0]], out[rows == values[-1]] = values[-1], values[0]
    return out


def along_the_ray(rows: Rows) -> Rows:
    height, width = rows.shape[1:3]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return np.asarray(rows * np.sqrt(1 + 0.45 * (x * x + y * y)), dtype=rows.dtype)


def moved(right: float, down: float) -> Fault:
    shift = (0, down, right, 0)
    return lambda rows: ndimage.shift(rows.astype(np.float32), shift, order=1, mode="nearest").astype(np.uint8)


def turned(degrees: float) -> Fault:
    resample = Image.Resampling.BICUBIC
    return lambda rows: np.stack([np.asarray(Image.fromarray(row).rotate(degrees, resample)) for row in rows])


def wider(times: float) -> Fault:
    def fault(rows: Rows) -> Rows:
        height, width = rows.shape[1:3]
        x = width / 2 * (1 - 1 / times)
        box, resize = (x, 0, width - x, height), Image.Resampling.BICUBIC
        return np.stack([np.asarray(Image.fromarray(row).resize((width, height), resize, box=box)) for row in rows])

    return fault


def softened(rows: Rows) -> Rows:
    return np.stack([np.asarray(Image.fromarray(row).filter(ImageFilter.GaussianBlur(1))) for row in rows])


def noisy(rows: Rows) -> Rows:
    return np.clip(rows + RANDOM.normal(0, 8, rows.shape), 0, 255).astype(np.uint8)


def spot(size: int) -> Fault:
    def fault(rows: Rows) -> Rows:
        out = rows.copy()
        out[:, 60 : 60 + size, 30 : 30 + size] //= 3
        return out

    return fault


def column(rows: Rows) -> Rows:
    out = rows.copy()
    out[:, :, rows.shape[2] // 3] = 0
    return out


def mixed(rows: Rows, matrix: Array) -> Rows:
    return np.clip(np.rint(rows.astype(np.float64) @ matrix.T), 0, 255).astype(np.uint8)


def saturated(share: float) -> Fault:
    grey = np.tile([0.299, 0.587, 0.114], (3, 1))
    return lambda rows: mixed(rows, share * np.eye(3) + (1 - share) * grey)


def as_bt709(rows: Rows) -> Rows:
    """Decoded by another matrix than they were encoded by (ITU-R BT.601 and BT.709)."""

    def luma_and_chroma(red: float, blue: float) -> Array:
        y = np.array([red, 1 - red - blue, blue])
        return np.stack([y, (np.array([0, 0, 1]) - y) / (2 - 2 * blue), (np.array([1, 0, 0]) - y) / (2 - 2 * red)])

    return mixed(rows, np.linalg.inv(luma_and_chroma(0.2126, 0.0722)) @ luma_and_chroma(0.299, 0.114))


COLOR: list[tuple[str, Fault, str]] = [
    ("one frame late", late(1), "image_lag"),
    ("two frames late", late(2), "image_lag"),
    ("three frames late", late(3), "image_lag"),
    ("one frame early", early, "image_lag"),
    ("backwards", lambda rows: rows[::-1], "odd_images"),
    ("stuck for ten frames", stuck(20, 30), "frozen"),
    ("stuck from the lift on", stuck(ONE + 10, 400), "frozen"),
    ("every other one twice", every_other_twice, "repeated_images"),
    ("one blurred", one(blurred), "odd_images"),
    ("one greenish", one(greenish), "odd_images"),
    ("one torn", torn, "odd_images"),
    ("one of the beginning", of_frame(0), "odd_images"),
    ("one of the end", of_frame(-1), "odd_images"),
    ("one shifted", one(rolled(4)), "odd_images"),
    ("one mirrored", one(lambda rows: rows[:, :, ::-1]), "odd_images"),
    ("one upside down", one(lambda rows: rows[:, ::-1]), "odd_images"),
    ("one inverted", one(lambda rows: 255 - rows), "odd_images"),
    ("one black", one(lambda rows: rows * 0), "odd_images"),
    ("one with red for blue", one(lambda rows: rows[..., ::-1]), "odd_images"),
    ("all inverted", lambda rows: 255 - rows, "images_as_drawn"),
    ("all darker", darker, "images_as_drawn"),
    ("all greenish", greenish, "images_as_drawn"),
    ("all with red for blue", lambda rows: rows[..., ::-1], "images_as_drawn"),
    ("all grey", grey, "images_as_drawn"),
    ("shifted to the right by two pixels", rolled(2), "projection"),
    ("shifted up by two pixels", rolled(-2, axis=1), "projection"),
    ("mirrored", lambda rows: rows[:, :, ::-1], "projection"),
    ("upside down", lambda rows: rows[:, ::-1], "projection"),
    ("turned by half", lambda rows: rows[:, ::-1, ::-1], "projection"),
    ("shifted to the left by one pixel", rolled(-1), "projection"),
    ("shifted down by one pixel", rolled(1, axis=1), "projection"),
    ("zoomed in", zoomed(1.2), "image_placement"),
    ("zoomed in by three hundredths", zoomed(1.03), "image_placement"),
]  # fmt: skip

FULL_SIZE: list[tuple[str, Fault, str]] = [
    ("half a pixel to the right", moved(0.5, 0.0), "image_placement"),
    ("half a pixel up and to the left", moved(-0.5, -0.5), "image_placement"),
    ("turned by half a degree", turned(0.5), "image_placement"),
    ("two percent too wide", wider(1.02), "image_placement"),
    ("blurred by a pixel", softened, "image_sharpness"),
    ("noise", noisy, "image_errors"),
    ("a dark spot", spot(5), "image_errors"),
    ("a dead column", column, "image_errors"),
    ("posterised", lambda rows: np.asarray(rows // 16 * 16 + 8, dtype=rows.dtype), "image_colors"),
    ("less saturated", saturated(0.8), "image_colors"),
    ("BT.709 for BT.601", as_bt709, "image_colors"),
    ("brighter by a fortieth", lambda rows: np.clip(rows * 1.05, 0, 255).astype(np.uint8), "image_colors"),
]
"""Faults too small for the cells."""

DEPTH: list[tuple[str, Fault, str]] = [
    ("one frame late", late(1), "image_lag"),
    ("one frame early", early, "image_lag"),
    ("stuck from the lift on", stuck(ONE + 10, 400), "depth_matches_scene"),
    ("one of the beginning", of_frame(0), "depth_matches_scene"),
    ("half of it", lambda rows: rows * np.float32(0.5), "depth_matches_scene"),
    ("twice as far", lambda rows: rows * np.float32(2), "depth_matches_scene"),
    ("millimetres", lambda rows: np.minimum(rows * 1000, 60).astype(np.float32), "depth_matches_scene"),
    ("one without hits", one(lambda rows: rows * 0), "depth_matches_scene"),
    ("mirrored", lambda rows: rows[:, :, ::-1], "depth_matches_scene"),
    ("upside down", lambda rows: rows[:, ::-1], "depth_matches_scene"),
    ("five hundredths too far", lambda rows: rows * np.float32(1.05), "depth_matches_scene"),
    ("along the ray", along_the_ray, "depth_matches_scene"),
    ("inverted", lambda rows: rows.max() - rows, "depth_matches_scene"),
    ("a centimetre too near", lambda rows: (rows - np.float32(0.01)).astype(np.float32), "pixels_as_drawn"),
    ("one percent too far", lambda rows: rows * np.float32(1.01), "pixels_as_drawn"),
    ("8 bit", lambda rows: (np.round(rows / 3 * 255) / 255 * 3).astype(np.float32), "pixels_as_drawn"),
    ("shifted by one pixel", rolled(1), "pixels_as_drawn"),
    ("noise", lambda rows: (rows + RANDOM.normal(0, 0.01, rows.shape)).astype(np.float32), "pixels_as_drawn"),
    ("edges smeared", lambda rows: ndimage.gaussian_filter(rows, (0, 1, 1)), "pixels_as_drawn"),
]

LABELS: list[tuple[str, Fault, str]] = [
    ("one frame late", late(1), "image_lag"),
    ("one frame early", early, "image_lag"),
    ("stuck from the lift on", stuck(ONE + 10, 400), "segmentation_matches_scene"),
    ("one of the beginning", of_frame(0), "segmentation_matches_scene"),
    ("two labels swapped", swapped_labels, "segmentation_matches_scene"),
    ("all numbers one larger", lambda rows: np.where(rows >= 0, rows + 1, rows), "segmentation_matches_scene"),
    ("bodies without links", lambda rows: np.where(rows >= 0, rows & 0xFFFFFF, rows), "segmentation_matches_scene"),
    ("one of nothing", one(lambda rows: rows * 0 - 1), "segmentation_matches_scene"),
    ("mirrored", lambda rows: rows[:, :, ::-1], "segmentation_matches_scene"),
    ("upside down", lambda rows: rows[:, ::-1], "segmentation_matches_scene"),
    ("grown by two pixels", lambda rows: ndimage.maximum_filter(rows, size=(1, 5, 5)), "pixels_as_drawn"),
    ("shrunk by a pixel", lambda rows: ndimage.minimum_filter(rows, size=(1, 3, 3)), "pixels_as_drawn"),
    ("shifted by one pixel", rolled(-1, axis=1), "pixels_as_drawn"),
]

CASES: list[tuple[ImageKind, str, Fault, str]] = [
    *(("color", *row) for row in (*COLOR, *FULL_SIZE)),
    *(("depth", *row) for row in DEPTH),
    *(("labels", *row) for row in LABELS),
]


def test_the_good_one_passes(good: Good) -> None:
    assert [r for r in checked(good.episode.path).results if r.level in ("warn", "fail")] == []
    spoilt = good.with_images({})
    for name in sorted({check for *_, check in CASES}):
        result = CHECKS.load(name).run(spoilt)
        assert result.level == "pass", (name, result.value, result.detail)


@pytest.mark.parametrize(("kind", "name", "fault", "check"), CASES, ids=[f"{kind}: {name}" for kind, name, *_ in CASES])
@pytest.mark.parametrize("camera", ["front", pytest.param("wrist", marks=[pytest.mark.slow, pytest.mark.long])])
def test_a_fault(camera: str, kind: ImageKind, name: str, fault: Fault, check: str, good: Good) -> None:
    rows = good.images[camera, kind]
    changed = fault(rows)
    assert not np.array_equal(changed, rows)
    result = CHECKS.load(check).run(good.with_images({(camera, kind): changed}))
    assert result.level == "fail", (result.value, result.detail)


@pytest.fixture(scope="module")
def poses(good: Good) -> Array:
    """(T, n, 7) of everything that can be seen."""
    info, columns = good.episode.info, good.episode.columns
    joints, objects = columns.joint_position, columns.object_poses
    return RecordedWorld(info.robot, info.scene, joint_position=joints, object_poses=objects).all_poses


def drawn_in_part(good: Good, changed: Mapping[tuple[str, ImageKind], Rows], poses: Array) -> CheckedEpisode:
    """The episode with other images, as if it had colour alone: only some of its frames are drawn."""
    episode, whole = good.with_images(changed), good.episode._drawn
    assert isinstance(whole, DrawnEpisode)
    frames = frames_to_draw([episode.images(camera).cells for camera in episode.cameras], poses)
    cells = {key: rows.copy() for key, rows in whole.cells.items() if key[1] == "color"}
    for rows in cells.values():
        rows[np.setdiff1d(np.arange(len(rows)), frames)] = 0  # so that nothing but what is drawn counts
        fill_between(rows, frames)
    episode.__dict__["_drawn"] = DrawnEpisode(frames=frames, cells=cells, shift={})
    episode._comparisons.clear()
    return episode


def test_the_good_one_passes_drawn_in_part(good: Good, poses: Array) -> None:
    episode = drawn_in_part(good, {}, poses)
    assert isinstance(episode._drawn, DrawnEpisode)
    assert len(episode._drawn.frames) < 0.9 * episode.num_frames
    for name in sorted({check for *_, check in COLOR} - {"image_lag"}):  # it also asks for depth and labels
        result = CHECKS.load(name).run(episode)
        assert result.level == "pass", (name, result.value, result.detail)
    for camera in episode.cameras:
        part, whole = episode.compared(camera), good.episode.compared(camera)
        assert isinstance(part, ImageComparison)
        assert isinstance(whole, ImageComparison)
        assert part.lag == pytest.approx(whole.lag, abs=0.03)
        assert part.shift == pytest.approx(whole.shift, abs=0.001)


@pytest.mark.parametrize(("name", "fault", "check"), COLOR, ids=[name for name, *_ in COLOR])
@pytest.mark.parametrize("camera", ["front", pytest.param("wrist", marks=[pytest.mark.slow, pytest.mark.long])])
def test_a_fault_of_one_drawn_in_part(
    camera: str, name: str, fault: Fault, check: str, good: Good, poses: Array
) -> None:
    episode = drawn_in_part(good, {(camera, "color"): fault(good.images[camera, "color"])}, poses)
    if check == "image_lag":
        compared = episode.compared(next(c for c in episode.cameras if c.name == camera))
        assert isinstance(compared, ImageComparison)
        assert compared.lag is not None
        assert abs(compared.lag) > CHECKS.load(check).fail
        return
    result = CHECKS.load(check).run(episode)
    assert result.level == "fail", (result.value, result.detail)


def test_what_does_not_move_is_not_measured(good: Good) -> None:
    still = RecordedStill(good)
    result = CHECKS.load("image_lag").run(still.episode)
    assert result.level == "skip"
    assert "too little moves" in result.detail


class RecordedStill:
    """The good recording as if nothing had moved in it."""

    def __init__(self, good: Good) -> None:
        first = {key: np.repeat(rows[:1], len(rows), axis=0) for key, rows in good.images.items()}
        self.episode = good.with_images(first)
        drawn = good.episode._drawn
        assert isinstance(drawn, DrawnEpisode)
        still = {key: np.repeat(cells[:1], len(cells), axis=0) for key, cells in drawn.cells.items()}
        self.episode.__dict__["_drawn"] = DrawnEpisode(frames=drawn.frames, cells=still, shift={})

"""Checks of images: they decode, show content, change with the robot, and belong to this camera and episode."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Fault, NotApplicableError, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import held_period, runs
from demorec.extensions.doctor.thumbnails import CameraThumbnails, EpisodeThumbnails
from demorec.extensions.doctor.units import other_units

MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
MAX_BLANK_SPREAD = 3.0
"""Maximum standard deviation, of 255, of a blank thumbnail, in which noise averages out."""
FROZEN_RATIO = 0.08
"""Maximum change of a repeated image, relative to the usual change while the robot moves."""
MIN_MISSING_CHANGE = 4.0
"""Minimum change expected from the joints' motion while images repeat, in multiples of an image's usual change."""
MAX_FROZEN_STEP = 8
"""Maximum change of a cell of the thumbnails, of 255, over a run of repeats: small motion adds up, a codec's errors do
not."""
MIN_FROZEN_FRAMES = 3
MIN_EQUAL = 0.5
"""Minimum ratio of images that repeat every pixel: videos of a low rate skip small changes, but seldom all."""
FROZEN_TIMES = 4.0
"""Minimum factor over the longest usual missing change: cameras that rarely see the arm repeat images for long."""
MIN_VISIBLE = 0.25
"""Minimum change, relative to the usual one, at which motion is visible in every new image."""
MIN_GAPS = 8
"""Minimum number of intervals between new images that determine the rate of a camera."""
MIN_REGULAR = 0.95
"""Minimum ratio of these intervals within one frame of their mean for a camera with its own rate."""
DRIFT_GAPS = 40
"""Number of gaps of one and two frames that determine whether they are regular: 40 random ones drift by 4 frames."""
MAX_DRIFT = 2.0
"""Maximum drift of regular gaps, frames: one by rounding, one by a late image."""
MIN_RATE_CHANGE = 1.5
"""Minimum usual change of images, of 255, for a close examination: codecs skip smaller ones in every second image."""
MIN_REPEATED = 0.3
"""Minimum ratio of repeated images of a camera that is slower than the frames."""
MIN_REPEATED_IRREGULARLY = 0.2
"""The same ratio, without a regular order, of images that repeat every pixel: a dropped image is copied, slow motion
and codecs seldom leave every pixel as it was."""
REPEATED_TIMES = 3.0
"""Minimum factor over the usual ratio of repeated images of an unusual episode."""
MIN_REPEATED_OF_FEW = 0.45
"""The same ratio in up to three episodes: a codec that skips every third image of slow motion looks like a camera."""
MIN_FIT = 0.8
"""Minimum correlation of an episode's mean image with that of another camera, or with its rotated own, that implies the
same view."""
MIN_FIT_GAIN = 0.3
"""Minimum excess over the correlation with its own."""
MAX_TWIN_DIFFERENCE = 1.0
"""Maximum mean difference of thumbnails, of 255, of two cameras with the same view."""
MIN_FRAMES = 20
"""Minimum number of frames for the fit."""
_SWEEPS = 100


@check(
    family="images",
    needs="images",
    measures="images that do not decode",
    unit="episodes",
    why="Training ends with an error when it reaches them.",
    do="download or record them again, or drop the episode: " + DROP,
)
def undecodable_images(evidence: Evidence) -> Iterator[Fault]:
    """Decode every image of every colour camera."""
    for camera, images in evidence.need_images().items():
        if images.errors and not images.episodes:
            number, error = next(iter(images.errors.items()))
            yield Fault(
                severity="broken",
                value=f"{len(images.errors)} episodes",
                message=f"no image of {camera} can be read (episode {number}: {error})",
                do="download the videos again, or check tables alone: demorec check {path} --no-images",
            )
            continue
        for number, error in images.errors.items():
            yield Fault(severity="broken", episode=number, value="1 camera", message=f"{camera}: {error}")


@check(
    family="images",
    needs="images",
    measures="blank images",
    unit="frames",
    why="The policy acts without seeing, and learns to ignore the camera.",
    do=DROP,
)
def blank_images(evidence: Evidence) -> Iterator[Fault]:
    """Find images of uniform brightness: black, grey, or from a lost signal."""
    for camera, images in evidence.need_images().items():
        blank = {number: _spread(each) < MAX_BLANK_SPREAD for number, each in images.episodes.items()}
        if blank and np.mean([flags.mean() for flags in blank.values()]) > 0.9:
            yield Fault(
                severity="broken",
                value="all frames",
                message=f"{camera} shows nothing in any episode",
                do="leave the camera out: demorec dataset drop-features {path} " + shlex.quote(camera) + " --out NEW",
            )
            continue
        for number, flags in blank.items():
            if flags.any():
                first, last = _bounds(flags)
                yield Fault(
                    severity="broken",
                    episode=number,
                    frames=(first, last),
                    value=f"{int(flags.sum())} frames",
                    message=f"{camera} shows nothing in {int(flags.sum())} frames, first in frame {first}",
                )


def _spread(images: EpisodeThumbnails) -> Array:
    """Compute (N,) standard deviation of each thumbnail."""
    return np.asarray(images.thumbnails.std(axis=(1, 2), dtype=np.float64))


def _bounds(flags: NDArray[np.bool_]) -> tuple[int, int]:
    places = np.flatnonzero(flags)
    return int(places[0]), int(places[-1])


@check(
    family="images",
    needs="images, state",
    measures="images that do not change while the robot moves",
    unit="s",
    why="The policy learns actions for a scene that it does not see.",
    do=DROP,
)
def frozen_images(evidence: Evidence) -> Iterator[Fault]:
    """Find images that repeat while joints move in a way that usually changes them.

    The effect of each joint on a camera's images is fitted to all episodes. A camera that often shows the same while
    the robot moves is judged by its own longest rests.
    """
    evidence.need_state()
    for camera, images in evidence.need_images().items():
        rests = {n: _rests(evidence, n, each, images) for n, each in images.episodes.items()}
        visible = evidence.once(visible_motion, images)
        if visible is None or (len(rests) <= MIN_OTHERS and visible.usual_change < MIN_RATE_CHANGE):
            continue
        longest = {number: max((rest[0] for rest in found), default=0.0) for number, found in rests.items()}
        for number, found in rests.items():
            others = [missing for other, missing in longest.items() if other != number]
            least = MIN_MISSING_CHANGE if len(others) >= MIN_OTHERS else 3 * MIN_MISSING_CHANGE
            limit = max(least, FROZEN_TIMES * float(np.median(others or [0.0])))
            bad = [rest for rest in found if rest[0] > limit and rest[2] - rest[1] >= MIN_FROZEN_FRAMES]
            if bad:
                _, first, end, equal = max(bad)
                yield Fault(
                    severity="broken" if equal >= MIN_EQUAL else "look",
                    episode=number,
                    frames=(first, end),
                    value=f"{evidence.seconds(end - first):.1f} s",
                    message=f"{camera} shows one image for {evidence.seconds(end - first):.1f} s while the robot moves",
                )


def _rests(
    evidence: Evidence, number: int, images: EpisodeThumbnails, camera: CameraThumbnails
) -> list[tuple[float, int, int, float]]:
    """Find (missing change, in images; first frame, last frame, ratio of equal images) of each run of repeats.

    The first and the last image must be alike, too.
    """
    visible = evidence.once(visible_motion, camera)
    episode = evidence.by_number.get(number)
    if visible is None or episode is None or episode.state is None or len(images.frames) < 2:
        return []
    same = _repeats(images, visible.usual_change)
    expected = np.concatenate([[0.0], np.cumsum(visible.expected(evidence, episode, images))])
    return [
        (
            float(expected[end] - expected[first]) / visible.usual_change,
            int(images.frames[first]),
            int(images.frames[end]),
            float(np.mean(images.change[first + 1 : end + 1] == 0)),
        )
        for first, end in runs(same)
        if np.ptp(images.thumbnails[[first, end]].astype(np.int16), axis=0).max() <= MAX_FROZEN_STEP
    ]


def _repeats(images: EpisodeThumbnails, usual_change: float) -> NDArray[np.bool_]:
    """Find (N - 1,) whether each image repeats the previous one: neither its pixels nor its thumbnail change."""
    pixels = images.change[1:] <= FROZEN_RATIO * usual_change
    return np.asarray(pixels | ((images.steps == 0) & (images.change[1:] <= 3 * FROZEN_RATIO * usual_change)))


@check(
    family="images",
    needs="images, state",
    measures="cameras slower than the frames",
    unit="% of moving frames",
    why="Repeated images are old; the policy cannot see the speed of motion.",
    do="record at the camera's own rate, or accept it: the images are late by up to a period",
)
def repeated_images(evidence: Evidence) -> Iterator[Fault]:
    """Find cameras with repeated images in the moving frames: a third of them regularly, or a fifth exactly.

    In a single episode, or a set of up to three, it must be half of them. A keyframe changes a repeated image, so that
    for a camera at a third of the rate or less the repeats between keyframes count.
    """
    evidence.need_state()
    for camera, images in evidence.need_images().items():
        shares: dict[int, float] = {}
        equal: dict[int, float] = {}
        visible = evidence.once(visible_motion, images)
        for number, each in images.episodes.items():
            episode = evidence.by_number.get(number)
            if visible is None or episode is None or episode.state is None or len(each.frames) < 2:
                continue
            visibly = visible.expected(evidence, episode, each) > MIN_VISIBLE * visible.usual_change
            repeats = _repeats(each, visible.usual_change)
            changed = np.flatnonzero(~repeats & visibly)
            gaps = np.diff(changed)[visibly[changed[1:] - 1]] if len(changed) > 1 else np.zeros(0, dtype=np.intp)
            if len(gaps) >= MIN_GAPS and visible.usual_change >= MIN_RATE_CHANGE:
                period = held_period(repeats, visibly)
                shares[number] = 1 - 1 / period if period > 2 else _share_repeated(gaps)
                equal[number] = float(np.mean(each.change[1:][visibly] == 0))
        if not shares:
            continue
        least = MIN_REPEATED if len(shares) > MIN_OTHERS else MIN_REPEATED_OF_FEW
        slow = [number for number, share in shares.items() if share > least]
        if len(slow) > len(shares) / 2:
            share = float(np.median(list(shares.values())))
            rate = evidence.fps * (1 - share)
            yield Fault(
                severity="look",
                value=f"{share:.0%} of moving frames",
                message=f"{camera} repeats {share:.0%} of its images: its rate is {rate:.0f} images per second, not "
                f"{evidence.fps:g}",
            )
            continue
        usual, typical = (float(np.median(list(each.values()))) for each in (equal, shares))
        if usual > MIN_REPEATED_IRREGULARLY:
            yield Fault(
                severity="look",
                value=f"{usual:.0%} of moving frames",
                message=f"{camera} repeats {usual:.0%} of its images while the robot moves, in no regular order",
            )
        for number in slow:
            if shares[number] > max(MIN_REPEATED_OF_FEW, REPEATED_TIMES * max(usual, typical)):
                yield Fault(
                    severity="look",
                    episode=number,
                    value=f"{shares[number]:.0%} of moving frames",
                    message=f"{camera} repeats {shares[number]:.0%} of its images",
                    do=DROP,
                )


def _share_repeated(gaps: NDArray[np.intp]) -> float:
    """Compute the ratio of repeated images if new ones come regularly, after n or n + 1 frames; else 0.

    Slow motion also changes an image only occasionally, but not regularly. Gaps of one and two frames are regular if
    their sum never drifts far from that of equal ones.
    """
    mean = float(np.mean(gaps))
    regular = (np.abs(gaps - mean) < 1.0).mean() >= MIN_REGULAR
    if mean < 2:
        blocks = [gaps[first : first + DRIFT_GAPS] for first in range(0, len(gaps) - DRIFT_GAPS + 1, DRIFT_GAPS)]
        drifts = [np.ptp(np.cumsum(block - block.mean())) for block in blocks]
        regular = bool(drifts) and np.median(drifts) < MAX_DRIFT
    return 1 - 1 / mean if regular else 0.0


@check(
    family="images",
    needs="images of three episodes",
    measures="cameras that are exchanged or rotated",
    unit="correlation",
    why="The policy sees the wrong view under the name of the right one.",
    do=DROP,
)
def camera_views(evidence: Evidence) -> Iterator[Fault]:
    """Compare the mean image of each episode with the usual ones of all cameras, upright, mirrored and rotated.

    Cameras with views that vary much between episodes are not judged.
    """
    views = {camera: _view(images) for camera, images in evidence.need_images().items()}
    if not any(len(images.episodes) > MIN_OTHERS - 1 for images in evidence.cameras.values()):
        raise NotMeasuredError(f"it needs {MIN_OTHERS} episodes with images")
    for camera, images in evidence.cameras.items():
        if len(images.episodes) <= MIN_OTHERS - 1:
            continue
        fits = {number: _correlation(each.mean, views[camera]) for number, each in images.episodes.items()}
        if np.median(list(fits.values())) < MIN_FIT:
            continue
        for number, fit in fits.items():
            mean = images.episodes[number].mean
            others = {
                f"the view of {other}": _correlation(mean, view) for other, view in views.items() if other != camera
            }
            others |= {f"the view {words}": _correlation(turned, views[camera]) for words, turned in _turned(mean)}
            name, best = max(others.items(), key=lambda item: item[1], default=("", 0.0))
            if best > MIN_FIT and best - fit > MIN_FIT_GAIN:
                yield Fault(
                    severity="broken",
                    episode=number,
                    value=f"{fit:.2f}",
                    message=f"{camera} shows {name} in this episode",
                )


def _view(images: CameraThumbnails) -> Array:
    """Compute the (16, 16) median of the episodes' mean images."""
    means = [each.mean for each in images.episodes.values() if len(each.thumbnails)]
    return np.asarray(np.median(np.stack(means), axis=0)) if means else np.zeros((16, 16))


def _correlation(one: Array, two: Array) -> float:
    one, two = one - one.mean(), two - two.mean()
    size = float(np.sqrt((one**2).sum() * (two**2).sum()))
    return float((one * two).sum()) / size if size > 0 else 0.0


def _turned(image: Array) -> Iterator[tuple[str, Array]]:
    yield "upside down", image[::-1, ::-1]
    yield "mirrored", image[:, ::-1]
    yield "flipped", image[::-1]
    yield "turned by 90 degrees", np.rot90(image)
    yield "turned by 90 degrees", np.rot90(image, 3)


@check(
    family="images",
    needs="two cameras",
    measures="two cameras that show the same view",
    unit="of 255",
    why="One of the two views is lost; the policy gets the same image twice.",
    do=DROP,
)
def doubled_cameras(evidence: Evidence) -> Iterator[Fault]:
    """Compare the thumbnails of each pair of cameras, frame by frame."""
    cameras = list(evidence.need_images().items())
    if len(cameras) < 2:
        raise NotApplicableError("there is one camera")
    for place, (name, images) in enumerate(cameras):
        for other_name, other in cameras[place + 1 :]:
            both = images.episodes.keys() & other.episodes.keys()
            same = [n for n in sorted(both) if _are_the_same(images.episodes[n], other.episodes[n])]
            if same and len(same) > len(both) / 2:
                yield Fault(
                    severity="broken",
                    value=f"{len(same)} episodes",
                    message=f"{name} and {other_name} show the same in {len(same)} of {len(both)} episodes",
                    do="leave one out: demorec dataset drop-features {path} " + shlex.quote(other_name) + " --out NEW",
                )
                continue
            for number in same:
                yield Fault(
                    severity="broken", episode=number, message=f"{name} and {other_name} show the same in this episode"
                )


def _are_the_same(one: EpisodeThumbnails, two: EpisodeThumbnails) -> bool:
    if len(one.thumbnails) != len(two.thumbnails) or not len(one.thumbnails) or _spread(one).max() < MAX_BLANK_SPREAD:
        return False
    error = np.abs(one.thumbnails.astype(np.int16) - two.thumbnails.astype(np.int16)).mean(axis=(1, 2))
    return float(np.quantile(error, 0.9)) < MAX_TWIN_DIFFERENCE


@dataclass(frozen=True, kw_only=True, eq=False)
class VisibleMotion:
    """Effect of motion on the images of a camera.

    Attributes:
        weights: (D,) change of an image, of 255, for a step of each element by its usual range.
        usual_change: Change of an image while the robot moves fast, of 255.
    """

    weights: Array
    usual_change: float

    def expected(self, evidence: Evidence, episode: EpisodeEvidence, images: EpisodeThumbnails) -> Array:
        """Compute (N - 1,) change between consecutive images expected from the motion, at most the usual one."""
        return np.asarray(np.minimum(_steps(evidence, episode, images) @ self.weights, 2 * self.usual_change))


def visible_motion(evidence: Evidence, camera: CameraThumbnails) -> VisibleMotion | None:
    """Fit the change of a camera's images to the joints' steps; None if nothing moves or changes."""
    steps: list[Array] = []
    changes: list[Array] = []
    for number, images in camera.episodes.items():
        episode = evidence.by_number.get(number)
        if episode is None or episode.state is None or len(images.frames) < 2 or number in evidence.once(other_units):
            continue
        steps.append(_steps(evidence, episode, images))
        changes.append(images.change[1:].astype(np.float64))
    if not steps or sum(map(len, steps)) < MIN_FRAMES:
        return None
    x, y = np.concatenate(steps), np.concatenate(changes)
    rest = float(np.median(y[x.max(axis=1, initial=0.0) == 0])) if (x == 0).all(axis=1).any() else 0.0
    weights = _non_negative_fit(x.T @ x, x.T @ np.maximum(y - rest, 0.0))
    moving = y[x @ weights > np.median(x @ weights)]
    usual_change = float(np.quantile(moving, 0.75)) if len(moving) else 0.0
    return VisibleMotion(weights=weights, usual_change=usual_change) if usual_change > 0 else None


def _non_negative_fit(squares: Array, products: Array) -> Array:
    """Solve (D,) non-negative least squares weights by coordinate descent on the normal equations."""
    weights = np.zeros(len(products))
    for _ in range(_SWEEPS):
        for place in np.flatnonzero(np.diag(squares) > 0):
            rest = products[place] - squares[place] @ weights
            weights[place] = max(0.0, weights[place] + rest / squares[place, place])
    return weights


def _steps(evidence: Evidence, episode: EpisodeEvidence, images: EpisodeThumbnails) -> Array:
    """Compute (N - 1, D) size of each element's step between images, in units of its usual range."""
    assert episode.state is not None
    position = episode.state[np.minimum(images.frames, len(episode.state) - 1)]
    ranges = evidence.ranges
    return np.asarray(np.abs(np.diff(position, axis=0)) / np.where(ranges > 0, ranges, np.inf))

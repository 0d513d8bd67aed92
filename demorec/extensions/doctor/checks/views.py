"""Checks of images against the state: whether they show this motion, at this time.

If the state explains the images of the other episodes (`view_fit.py`), an episode with delayed or unexplained images
has images of another time or recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.extensions.doctor.evidence import DROP, LOOK_OR_DROP, Evidence
from demorec.extensions.doctor.robust import usual
from demorec.extensions.doctor.view_fit import MAX_UNRELATED_RATIO, MIN_EPISODES, MIN_FRAMES, ViewFit, view_fits

MIN_EXPLAINED = 0.35
"""Minimum ratio of the images' variance that the state usually explains, for a camera to be judged."""
MAX_SET_LAG_S = 0.3
"""Maximum usual delay of images after the state: cameras need 30 to 150 ms."""
MIN_SHIFT = 1.5
"""Minimum offset, frames, of an early or late episode's images."""
MIN_GAIN = 1.4
"""Minimum factor by which an episode's own lag reduces the unexplained variance, compared with the usual one."""

MIN_TAKE_EXPLAINED = 0.65
"""As MIN_EXPLAINED, to find images of another take: where the fit is poor, another state fits better by chance."""
MIN_TAKES = 8
"""Minimum number of episodes to find one of another take: a fit to fewer does not reach where only one episode goes."""
MIN_OTHER_RATIO = 0.5
"""Minimum part of the usually explained variance that another episode's state must explain."""
MIN_OTHER_GAIN = 2.0
"""Minimum factor by which the state of another episode reduces the unexplained variance, relative to the largest such
factor of episodes whose own state explains the images as usual."""


@check(
    family="images",
    needs="images, state, five episodes",
    measures="images that come early or late",
    unit="frames",
    why="The policy sees images from a different time than the action.",
    do=DROP,
)
def image_lag(evidence: Evidence) -> Iterator[Fault]:
    """Find the delay at which the images match the state best: in the set, and in each episode against the others."""
    for camera, fits in _judged(evidence, MIN_EPISODES):
        lags = {number: fit.lag for number, fit in fits.items()}
        usual_lag, spread = usual(list(lags.values()), floor=0.2)
        images = evidence.cameras[camera].episodes
        changed = {number: float(np.mean(images[number].change != 0)) for number in fits}
        usual_changed = float(np.median(list(changed.values())))
        if abs(usual_lag) > max(MAX_SET_LAG_S * evidence.fps, 2.0):
            yield Fault(
                severity="look",
                value=f"{evidence.seconds(usual_lag):+.2f} s",
                message=f"{camera} follows the state by {evidence.seconds(usual_lag):+.2f} s",
                do="compare the clocks of camera and robot in the recorder",
            )
        for number, fit in fits.items():
            shift = lags[number] - usual_lag
            if changed[number] < usual_changed / 2:
                continue  # another check reports images that stand still
            if abs(shift) > max(MIN_SHIFT, 6 * spread) and _gain(fit, usual_lag) > MIN_GAIN:
                yield Fault(
                    severity="broken",
                    episode=number,
                    value=f"{shift:+.1f} frames",
                    message=f"{camera} is {abs(shift):.1f} frames {'late' if shift > 0 else 'early'} in this episode",
                )


def _gain(fit: ViewFit, usual_lag: float) -> float:
    place = int(np.argmin(np.abs(fit.lags - usual_lag)))
    return float((1 - fit.explained[place]) / max(1 - fit.explained.max(), 1e-3))


@check(
    family="images",
    needs="images, state, eight episodes",
    measures="images of another recording",
    unit="% explained",
    why="The policy learns actions that do not belong to the images.",
    do=LOOK_OR_DROP,
)
def image_take(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes with images that the state of another episode explains far better than their own, at any lag.

    Images that no state explains are not evidence: the robot may be where no other episode was. The gain must be an
    outlier among those of usual episodes, since the states of similar episodes explain each other's images. All cameras
    are of one take: an episode is not reported if its state explains the images of another camera as usual. A fit on a
    few episodes is no proof, so a person should look.
    """
    judged = dict(_judged(evidence, MIN_TAKES))
    usual_bests = {camera: float(np.median([fit.best for fit in fits.values()])) for camera, fits in judged.items()}
    judged = {camera: fits for camera, fits in judged.items() if usual_bests[camera] >= MIN_TAKE_EXPLAINED}
    if not judged:
        raise NotMeasuredError("the state explains too little of the images")
    confirmed = {
        number
        for camera, fits in judged.items()
        for number, fit in fits.items()
        if fit.best > MIN_OTHER_RATIO * usual_bests[camera]
    }
    for camera, fits in judged.items():
        usual_best = usual_bests[camera]
        gains = {number: _other_gain(fit) for number, fit in fits.items() if fit.by_another is not None}
        usual_gain = max((gains[n] for n in gains if fits[n].best >= MAX_UNRELATED_RATIO * usual_best), default=1.0)
        for number, gain in gains.items():
            fit = fits[number]
            explained = fit.by_another or 0.0
            is_other = explained > MIN_OTHER_RATIO * usual_best and gain > MIN_OTHER_GAIN * max(usual_gain, 1.0)
            if is_other and number not in confirmed:
                yield Fault(
                    severity="look",
                    episode=number,
                    value=f"{max(fit.best, 0):.0%}",
                    message=f"{camera} does not show the motion of this episode: its state explains "
                    f"{max(fit.best, 0):.0%} of the changes, that of another episode {explained:.0%}",
                )


def _other_gain(fit: ViewFit) -> float:
    """Compute the factor by which the state of another episode reduces the unexplained variance."""
    return (1 - fit.best) / max(1 - (fit.by_another or 0.0), 1e-3)


def _judged(evidence: Evidence, min_episodes: int) -> Iterator[tuple[str, Mapping[int, ViewFit]]]:
    """Yield each camera with images that the state usually explains."""
    evidence.need_state(MIN_FRAMES)
    reasons = []
    for camera in evidence.need_images():
        fits = evidence.once(view_fits).get(camera, {})
        if len(fits) < min_episodes:
            reasons.append(f"{camera} has fewer than {min_episodes} episodes of {MIN_FRAMES} frames")
        elif np.median([fit.explained.max() for fit in fits.values()]) < MIN_EXPLAINED:
            reasons.append(f"{camera} shows too little of the robot")
        else:
            yield camera, fits
    if len(reasons) == len(evidence.cameras):
        raise NotMeasuredError("; ".join(reasons))

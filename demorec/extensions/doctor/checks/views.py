"""Checks of images against the state: do they show this motion, at this time?

Where the state explains the images of the other episodes (`view_fit.py`), an episode whose images follow it late, or
not at all, has images of another moment or take.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from demorec.extensions.doctor.base import DROP, Fault, check
from demorec.extensions.doctor.errors import NotMeasuredError
from demorec.extensions.doctor.evidence import Evidence
from demorec.extensions.doctor.robust import usual
from demorec.extensions.doctor.view_fit import MIN_EPISODES, MIN_FRAMES, ViewFit, view_fits

MIN_EXPLAINED = 0.35
"""Usual share of the images' variance that the state explains, from which a camera is judged."""
MAX_SET_LAG_S = 0.3
"""Time by which images usually follow the state, at most: cameras need 30 to 150 ms."""
MIN_SHIFT = 1.5
"""Frames by which an episode's images come early or late, at least."""
MIN_GAIN = 1.4
"""Times less variance that is left unexplained at an episode's own lag than at the usual one."""

MIN_OTHER_RATIO = 0.5
"""Share of what the state usually explains, from which the state of another episode explains the images."""
MIN_OTHER_GAIN = 2.0
"""Times less variance that the state of another episode leaves unexplained."""


@check(
    family="images",
    needs="images, state, five episodes",
    measures="images that come early or late",
    unit="frames",
    why="The policy sees another moment than the one that its action belongs to.",
    do=DROP,
)
def image_lag(evidence: Evidence) -> Iterator[Fault]:
    """Find by how many frames the images follow the state best: in the set, and in each episode against the others."""
    for camera, fits in _judged(evidence):
        lags = {number: fit.lag for number, fit in fits.items()}
        usual_lag, spread = usual(list(lags.values()), floor=0.2)
        if abs(usual_lag) > max(MAX_SET_LAG_S * evidence.fps, 2.0):
            yield Fault(
                severity="look",
                value=f"{evidence.seconds(usual_lag):+.2f} s",
                message=f"{camera} follows the state by {evidence.seconds(usual_lag):+.2f} s",
                do="compare the clocks of camera and robot in the recorder",
            )
        for number, fit in fits.items():
            shift = lags[number] - usual_lag
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
    needs="images, state, five episodes",
    measures="images of another take",
    unit="% explained",
    why="The policy learns actions that do not belong to the images.",
    do="look at it: demorec view {path} --episodes {episode}; then drop it: " + DROP,
)
def image_take(evidence: Evidence) -> Iterator[Fault]:
    """Find episodes whose images the state of another episode explains far better than their own, at any lag.

    Images that no state explains are no evidence: the robot may be where no other episode was.
    """
    for camera, fits in _judged(evidence):
        usual_best = float(np.median([fit.best for fit in fits.values()]))
        for number, fit in fits.items():
            gain = (1 - fit.best) / max(1 - fit.by_another, 1e-3)
            if fit.by_another > MIN_OTHER_RATIO * usual_best and gain > MIN_OTHER_GAIN:
                yield Fault(
                    severity="broken",
                    episode=number,
                    value=f"{max(fit.best, 0):.0%}",
                    message=f"{camera} does not show the motion of this episode: its state explains "
                    f"{max(fit.best, 0):.0%} of the changes, that of another episode {fit.by_another:.0%}",
                )


def _judged(evidence: Evidence) -> Iterator[tuple[str, Mapping[int, ViewFit]]]:
    """Yield each camera whose images the state usually explains."""
    evidence.need_state(MIN_FRAMES)
    reasons = []
    for camera in evidence.need_images():
        fits = evidence.once(view_fits).get(camera, {})
        if len(fits) < MIN_EPISODES:
            reasons.append(f"{camera} has fewer than {MIN_EPISODES} episodes of {MIN_FRAMES} frames")
        elif np.median([fit.explained.max() for fit in fits.values()]) < MIN_EXPLAINED:
            reasons.append(f"{camera} shows too little of the robot")
        else:
            yield camera, fits
    if len(reasons) == len(evidence.cameras):
        raise NotMeasuredError("; ".join(reasons))

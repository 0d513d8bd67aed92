"""Checks of the other measured columns: velocities, efforts, forces, poses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from demorec.check.base import Fault, NotMeasuredError, check
from demorec.core.geometry import Array
from demorec.extensions.doctor.evidence import DROP, EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import runs

MIN_LIVE_SHARE = 0.5
"""Minimum ratio of moving frames in which a sensor changes, for its rests to be judged."""
MIN_REST_S = 0.3
MIN_BROKEN_S = 1.0
MIN_OTHERS = 3
"""Minimum number of episodes to compare one with."""
REST_TIMES = 4.0
"""Minimum factor over the usual longest rest of the other episodes."""
MIN_SPEED = 0.3
"""Minimum speed, relative to the root mean square, at which the robot counts as moving."""


@check(
    family="numbers",
    needs="state, other measured columns",
    measures="sensors that stop changing",
    unit="s",
    why="The policy sees a force or a speed that is not there.",
    do=DROP,
)
def frozen_sensors(evidence: Evidence) -> Iterator[Fault]:
    """Find measured columns that repeat bit-exactly while the robot moves, though they usually change.

    A sensor may rest at zero, as a contact sensor does, or at a value that it keeps in half of the moving frames. Rests
    must exceed those of the other episodes: the pose of an object rests in each until the robot touches it.
    """
    episodes = evidence.need_state(8)
    measured = evidence.roles.having("sensor", "velocity", "pose")
    names = [name for name in measured if name not in evidence.roles.state and evidence.roles.columns[name].is_vector]
    if not names:
        raise NotMeasuredError("the state is the only measured column")
    for name in names:
        having = [episode for episode, _ in episodes if name in episode.columns]
        rests = [_longest_rest(episode, episode.columns[name]) or (0, 0, 0) for episode in having]
        for number, (episode, (first, end, moving)) in enumerate(zip(having, rests, strict=True)):
            others = [other for _, _, other in rests[:number] + rests[number + 1 :]]
            usual = float(np.median(others)) if len(others) >= MIN_OTHERS else 0.0
            seconds = evidence.seconds(moving)
            if seconds > MIN_REST_S and moving > REST_TIMES * usual:
                yield Fault(
                    severity="broken" if seconds > MIN_BROKEN_S else "look",
                    episode=episode.number,
                    frames=(first, end),
                    value=f"{seconds:.1f} s",
                    message=f"{name} keeps its values for {seconds:.1f} s while the robot moves",
                )


def _longest_rest(episode: EpisodeEvidence, table: Array) -> tuple[int, int, int] | None:
    """Find (first frame, last frame, moving frames) of the longest rest; None if the sensor often rests."""
    speed = episode.speed
    moves = speed > MIN_SPEED * np.sqrt((speed**2).mean()) if speed.any() else np.zeros(len(speed), dtype=np.bool_)
    same = (table[1:] == table[:-1]).all(axis=1) & table[1:].any(axis=1)
    counts = np.concatenate([[0], np.cumsum(same & moves)])
    found = [(int(counts[end] - counts[first]), first, end) for first, end in runs(same | ~moves)]
    moving, first, end = max(found, default=(0, 0, 0))
    outside = np.ones(len(same), dtype=np.bool_)
    outside[first:end] = False
    changes = (table[1:] != table[:-1]).any(axis=1) & moves & outside
    if not moving or changes.sum() < MIN_LIVE_SHARE * (moves & outside).sum():
        return None
    return first, end, moving

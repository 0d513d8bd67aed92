"""The two time lines of every recording: seconds since the episode's start, and frame numbers."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

SECONDS = "time"
FRAMES = "frame"


def indexes(time_ns: NDArray[np.int64], frame_times: NDArray[np.int64] | None) -> list[rr.TimeColumn]:
    """Time columns of rows at `time_ns`, each of which is the time of a frame; None for rows between frames."""
    seconds = rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]"))
    if frame_times is None:
        return [seconds]
    return [seconds, rr.TimeColumn(FRAMES, sequence=np.searchsorted(frame_times, time_ns))]

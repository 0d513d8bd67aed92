"""The two time lines of every recording: seconds since the episode's start, and frame numbers."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

SECONDS = "time"
FRAMES = "frame"


def indexes(time_ns: NDArray[np.int64], frame_times: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """Time columns of rows at `time_ns`, each of which is the time of a frame."""
    return [
        rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]")),
        rr.TimeColumn(FRAMES, sequence=np.searchsorted(frame_times, time_ns)),
    ]


def seconds_only(time_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """Time column of rows between frames, which have no frame number of their own."""
    return [rr.TimeColumn(SECONDS, duration=time_ns.astype("timedelta64[ns]"))]

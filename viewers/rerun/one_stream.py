"""Plot one recorded stream, here how closely the arm follows its targets, in Rerun.

python viewers/rerun/one_stream.py recordings/cubes/episodes/episode_000000.mcap tracking.rrd
rerun tracking.rrd
"""

import sys
from pathlib import Path

import numpy as np
import rerun as rr

from demorec.mcap import Recording


def main(recording_path: Path, target: Path) -> None:
    with Recording(recording_path) as recording:
        columns, joints = recording.columns(), recording.info.robot.arm_joints
    # Action t is reached at t + 1: the target of frame t is compared with the position one frame later.
    error = columns.joint_position[1:, : len(joints)] - columns.action_joint_target[:-1]
    stream = rr.RecordingStream("tracking", recording_id=recording_path.stem)
    stream.save(target)
    stream.log("tracking_error", rr.SeriesLines(names=list(joints)), static=True)
    stream.send_columns(
        "tracking_error",
        indexes=[rr.TimeColumn("time", duration=columns.time_ns[1:].astype("timedelta64[ns]"))],
        columns=rr.Scalars.columns(scalars=np.degrees(error)),
    )
    stream.disconnect()
    print(f"largest tracking error {np.degrees(np.abs(error).max()):.2f} degrees: {target}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

"""Plot one recorded stream, here how closely the arm follows its targets, in Rerun.

python viewers/rerun/one_stream.py recordings/cubes/episodes/episode_000000.mcap tracking.rrd
rerun tracking.rrd
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import rerun as rr

from demorec.api import DemorecError, Recording, find_recordings


def main(source: Path, target: Path) -> None:
    file = find_recordings([source])[0]
    with Recording(file) as recording:
        trajectory, joints = recording.trajectory(), recording.info.simulated.robot.arm_joints
    # Action t is reached at t + 1: the target of frame t is compared with the position one frame later.
    error = trajectory.joint_position[1:, : len(joints)] - trajectory.action_joint_target[:-1]
    stream = rr.RecordingStream("tracking", recording_id=file.stem)
    stream.save(target)
    stream.log("tracking_error", rr.SeriesLines(names=list(joints)), static=True)
    stream.send_columns(
        "tracking_error",
        indexes=[rr.TimeColumn("time", duration=trajectory.time_ns[1:].astype("timedelta64[ns]"))],
        columns=rr.Scalars.columns(scalars=np.degrees(error)),
    )
    stream.disconnect()
    print(f"largest tracking error {np.degrees(np.abs(error).max()):.2f} degrees: {target}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="a simulated recording, or a run, of which the first one is taken")
    parser.add_argument("target", type=Path, help="the .rrd file to write")
    try:
        main(**vars(parser.parse_args()))
    except DemorecError as error:
        sys.exit(str(error))

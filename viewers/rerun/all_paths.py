"""Every gripper path of a run in one 3D view: green where the episode succeeded, red where it failed.

python viewers/rerun/all_paths.py recordings/cubes paths.rrd
rerun paths.rrd
"""

import argparse
import sys
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from demorec.api import DemorecError, Recording, find_recordings

GREEN, RED = (80, 220, 120), (240, 80, 80)


def main(run: Path, target: Path) -> None:
    files = find_recordings([run])
    stream = rr.RecordingStream("paths", recording_id=run.resolve().name)
    stream.save(target, default_blueprint=rrb.Blueprint(rrb.Spatial3DView(name="gripper paths"), collapse_panels=True))
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for file in files:
        with Recording(file) as recording:
            base, outcome = recording.info.simulated.scene.robot.world_from_base, recording.outcome
            points = base.apply(recording.trajectory().base_from_tcp[:, :3])
        color = GREEN if outcome is not None and outcome.success else RED
        stream.log(f"paths/{file.stem}", rr.LineStrips3D([points], colors=[color], radii=[-1.5]), static=True)
    stream.disconnect()
    print(f"{len(files)} paths: {target}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run of generate-dataset, or one of its recordings")
    parser.add_argument("target", type=Path, help="the .rrd file to write")
    try:
        main(**vars(parser.parse_args()))
    except DemorecError as error:
        sys.exit(str(error))

"""A layout of your own around demorec's streams: the wrist camera large, the gripper's curves below it.

python viewers/rerun/own_layout.py recordings/cubes/episodes/episode_000000.mcap wrist.rrd
rerun wrist.rrd
"""

import argparse
import sys
from pathlib import Path

import rerun.blueprint as rrb

from demorec.api import DemorecError, Paths, find_episodes, log_episode, new_recording


def main(source: Path, target: Path, camera: str) -> None:
    paths = Paths()
    layout = rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial2DView(origin=paths.camera(camera), contents=["$origin"], name=camera),
            rrb.TimeSeriesView(
                origin="/", contents=[paths.curves("gripper"), paths.curves("gripper target")], name="opening (m)"
            ),
            rrb.TimeSeriesView(origin=paths.curves("contact_force (N)"), name="contact force (N)"),
            row_shares=[4, 1, 1],
        ),
        collapse_panels=True,
    )
    with find_episodes([source])[0].open() as episode:
        stream = new_recording(episode)
        stream.save(target, default_blueprint=layout)
        log_episode(stream, episode)
        stream.disconnect()
    print(f"{episode.name}, {episode.num_frames} frames: {target}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="a recording, or a run, of which the first one is taken")
    parser.add_argument("target", type=Path, help="the .rrd file to write")
    parser.add_argument("--camera", default="wrist")
    try:
        main(**vars(parser.parse_args()))
    except DemorecError as error:
        sys.exit(str(error))

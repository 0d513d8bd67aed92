"""External episodes in Rerun: every feature as a plot, every camera, the joints of its URDF."""

from __future__ import annotations

from pathlib import Path

from support.external import make_external, write_external

from demorec.view.sources import find_episodes


def test_an_episode_is_shown_from_its_first_frame_on(tmp_path: Path) -> None:
    given = make_external()
    path = write_external(tmp_path / "a.mcap", given)
    with find_episodes([path])[0].open() as episode:
        assert episode.info.simulation is None
        times = [frame.time_ns - given.frames[0].time_ns for frame in given.frames]
        assert episode.time_ns.tolist() == times
        assert set(episode.curves) == {"observation.state", "action", "observation.force"}
        assert set(episode.motion.joint_position) == {"shoulder", "elbow"}
        expected = [float(frame.samples["observation.state"].vector[1]) for frame in given.frames]
        assert episode.motion.joint_position["elbow"].tolist() == expected
        shown = [time_ns for time_ns, _, _ in episode.packets("wrist")]
        assert shown == times[1::2]  # each with the first frame that holds it

"""Good recordings as other people would have them: how many `demorec check` wrongly reports.

    python benchmarks/clean_imports.py --episodes 3 --out imports.jsonl     # of each layout and arm

Simulated episodes are written as other robots' recordings are: states at 120 Hz whose stamps jitter, images and
messages that arrive late, in bags of ROS 1, ROS 2 and Foxglove, HDF5 files, and datasets that LeRobot writes. Each is
checked as `demorec check` does, by the mapping that it finds itself. Warnings are printed, then a line a layout. What
stands in `--out` is not made again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from check_limits import record
from support import bags
from support.bags import Note, Notes
from support.commands import exit_code
from support.layouts import _foxglove

from demorec.core.config import GenerateConfig, VideoConfig
from demorec.core.tables import ROBOTS, TASKS
from demorec.mcap import open_recording

Rows = NDArray[Any]
NS = 1_000_000_000
JITTER_NS, LATENCY_NS, IMAGE_LATENCY_NS = 300_000, 500_000, 15_000_000
"""Of stamps, messages and images."""
AHEAD_NS = 2_000_000
"""By which a command is before the image that it stands beside."""
NOISE = 1e-5
"""Of encoders, rad, m."""
IMAGE = "/camera/image_raw/compressed"


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """What is written.

    Attributes:
        names: (D,) of the joints.
        state_ns, state: (S,) and (S, D) at 120 Hz.
        time_ns, frames, action: (T,), (T, D) states at the frames and (T, A) targets of the first A joints.
        pose, target, width: (T, 7), (T, 7) and (T,): the TCP, where it is sent, the gripper's opening.
        images: (T, H, W, 3).
        fps: Frames a second.
    """

    names: Sequence[str]
    state_ns: Rows
    state: Rows
    time_ns: Rows
    frames: Rows
    action: Rows
    pose: Rows
    target: Rows
    width: Rows
    images: Rows
    fps: int


def read_episode(path: Path) -> Episode | None:
    """Of a recording with joint states at the physics rate; None of a robot that is larger than its URDF says."""
    with open_recording(path) as recording:
        info, columns = recording.info, recording.columns()
        if info.scene.robot.scale != 1:
            return None
        samples = list(recording.joint_samples())
        moments = [*columns.time_ns.tolist(), *(sample.time_ns for sample in samples)]
        rows = [*columns.joint_position, *(sample.joint_position for sample in samples)]
        order = np.unique(moments, return_index=True)[1][::2]
        camera = next(camera.name for camera in info.scene.cameras)
        rng = np.random.default_rng(0)
        return Episode(
            names=info.robot.joint_names,
            state_ns=np.array(moments)[order],
            state=np.array(rows)[order] + rng.normal(0, NOISE, (len(order), columns.joint_position.shape[1])),
            time_ns=columns.time_ns,
            frames=columns.joint_position + rng.normal(0, NOISE, columns.joint_position.shape),
            action=columns.command_joint_target,
            pose=columns.base_from_tcp,
            target=columns.command_base_from_tcp,
            width=columns.gripper_width + rng.normal(0, NOISE, columns.num_frames),
            images=np.stack(list(recording.images(camera))),
            fps=info.fps,
        )


def notes_of(topic: str, kind: str, moments: Rows, body: Callable[[int], dict[str, Any]]) -> Notes:
    """Messages whose stamps jitter."""
    rng, late = np.random.default_rng(len(moments)), IMAGE_LATENCY_NS if "image" in topic else LATENCY_NS
    stamps = (np.asarray(moments) + bags.EPOCH_NS + rng.integers(0, JITTER_NS, len(moments))).tolist()
    has_header = not kind.startswith("std_msgs")
    return [
        Note(topic=topic, type=kind, log_ns=stamp + late, header_ns=stamp if has_header else 0, body=body(n))
        for n, stamp in enumerate(stamps)
    ]


def joint_states(e: Episode, topic: str = "/joint_states") -> Notes:
    return notes_of(
        topic, "sensor_msgs/msg/JointState", e.state_ns, lambda n: {"name": list(e.names), "position": e.state[n]}
    )


def joint_commands(e: Episode, topic: str = "/joint_command") -> Notes:
    names = list(e.names[: e.action.shape[1]])
    return notes_of(
        topic, "sensor_msgs/msg/JointState", e.time_ns - AHEAD_NS, lambda n: {"name": names, "position": e.action[n]}
    )


def trajectories(e: Episode) -> Notes:
    names = list(e.names[: e.action.shape[1]])
    return notes_of(
        "/leader/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", e.time_ns - AHEAD_NS,
        lambda n: {"joint_names": names, "points": [{"positions": e.action[n]}]},
    )  # fmt: skip


def arrays(topic: str, moments: Rows, rows: Rows) -> Notes:
    return notes_of(topic, "std_msgs/msg/Float64MultiArray", moments, lambda n: {"data": rows[n]})


def poses(topic: str, e: Episode, rows: Rows) -> Notes:
    def body(n: int) -> dict[str, Any]:
        place, turn = dict(zip("xyz", rows[n, :3], strict=True)), dict(zip("xyzw", rows[n, 3:], strict=True))
        return {"pose": {"position": place, "orientation": turn}}

    moments = e.time_ns - AHEAD_NS if rows is e.target else e.time_ns
    return notes_of(topic, "geometry_msgs/msg/PoseStamped", moments, body)


def compressed(e: Episode) -> Notes:
    return notes_of(
        IMAGE, "sensor_msgs/msg/CompressedImage", e.time_ns,
        lambda n: {"format": "jpeg", "data": np.frombuffer(bags.jpeg(e.images[n]), np.uint8)},
    )  # fmt: skip


def raw(e: Episode) -> Notes:
    height, width = e.images.shape[1:3]
    return notes_of(
        "/camera/image_raw", "sensor_msgs/msg/Image", e.time_ns,
        lambda n: {"encoding": "rgb8", "width": width, "height": height, "step": 3 * width, "data": e.images[n]},
    )  # fmt: skip


def ros2(notes: Notes, folder: Path) -> Path:
    return bags.write_rosbag2(bags.in_order(notes), folder / "bag")


def sqlite(notes: Notes, folder: Path) -> Path:
    return bags.write_rosbag2(bags.in_order(notes), folder / "bag", storage=StoragePlugin.SQLITE3)


def ros1(notes: Notes, folder: Path) -> Path:
    return bags.write_mcap(bags.in_order(notes), folder / "bag.mcap", is_ros1=True)


def widths(e: Episode) -> Notes:
    return notes_of("/gripper/width", "std_msgs/msg/Float64", e.time_ns, lambda n: {"data": float(e.width[n])})


def robomimic(e: Episode, folder: Path) -> Path:
    """A demonstration in the layout of robosuite."""
    path = folder / "demo.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": float(e.fps)}}
        )
        data.attrs["total"] = len(e.frames)
        demo = data.create_group("demo_0")
        demo.attrs["num_samples"] = len(e.frames)
        demo["actions"] = e.action
        demo["rewards"] = demo["dones"] = (np.arange(len(e.frames)) == len(e.frames) - 1).astype(np.int64)
        observed = demo.create_group("obs")
        observed["robot0_joint_pos"] = e.frames[:, : e.action.shape[1]]
        observed["robot0_eef_pos"], observed["robot0_eef_quat"] = e.pose[:, :3], e.pose[:, 3:]
        observed["agentview_image"] = e.images
    return path


def lerobot(e: Episode, folder: Path) -> Path:
    """A dataset that LeRobot writes."""
    from lerobot.datasets import LeRobotDataset

    names = [f"{name}.pos" for name in e.names[: e.action.shape[1]]]
    vector = {"dtype": "float32", "shape": (len(names),), "names": names}
    camera = {"dtype": "image", "shape": e.images.shape[1:], "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, "observation.images.front": camera}
    dataset = LeRobotDataset.create("local/x", fps=e.fps, features=features, root=folder / "ds", use_videos=False)
    for state, action, image in zip(e.frames, e.action, e.images, strict=True):
        dataset.add_frame(
            {
                "observation.state": state[: len(names)].astype(np.float32),
                "action": action.astype(np.float32),
                "observation.images.front": image,
                "task": "put it there",
            }
        )
    dataset.save_episode()
    dataset.finalize()
    return folder / "ds"


LAYOUTS: dict[str, Callable[[Episode, Path], Path]] = {
    "ROS 2, joint states": lambda e, f: ros2([*joint_states(e), *joint_commands(e), *compressed(e)], f),
    "ROS 2, SQLite, leader": lambda e, f: sqlite(
        [*joint_states(e, "/follower/joint_states"), *joint_commands(e, "/leader/joint_states"), *raw(e)], f
    ),
    "ROS 1": lambda e, f: ros1(
        [*joint_states(e), *joint_commands(e, "/joint_states_desired"), *compressed(e)], f
    ),
    "trajectories": lambda e, f: ros2([*joint_states(e), *trajectories(e), *compressed(e)], f),
    "a controller's commands": lambda e, f: ros2(
        [*joint_states(e), *arrays("/forward_position_controller/commands", e.time_ns - AHEAD_NS, e.action), *raw(e)], f
    ),
    "topics of numbers": lambda e, f: sqlite(
        [
            *arrays("/robot_state/joint_positions", e.state_ns, e.state[:, : e.action.shape[1]]),
            *arrays("/action/joint_position", e.time_ns - AHEAD_NS, e.action),
            *raw(e),
        ],
        f,
    ),
    "Foxglove": lambda e, f: _foxglove(
        bags.in_order([*joint_states(e), *joint_commands(e, "/teleop/joint_states"), *compressed(e)]), f
    ),
    "poses": lambda e, f: ros2(
        [*poses("/ee_pose", e, e.pose), *widths(e), *poses("/target_pose", e, e.target), *compressed(e)], f
    ),
    "HDF5": robomimic,
    "LeRobot": lerobot,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Row:
    """One episode in one layout; `alarms` are of each check that did not pass: level, name, value, detail."""

    layout: str
    robot: str
    task: str
    index: int
    settings: str = ""
    alarms: Sequence[Sequence[object]] = ()


def checked(path: Path) -> list[tuple[object, ...]]:
    """What `demorec check --json` says that does not pass."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(io.StringIO()):
        code = exit_code("check", path, "--json")
    if code not in (0, 1):
        return [("fail", f"exit code {code}", None, told.getvalue()[-300:])]
    results = [result for subject in json.loads(told.getvalue()) for result in subject["results"]]
    return [(r["level"], r["check"], r["value"], r["detail"]) for r in results if r["level"] in ("warn", "fail")]


def main() -> None:
    """Make what is missing and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--episodes", type=int, default=1, help="of each layout and arm")
    parser.add_argument("--minutes", type=float, default=1e6, help="start none after so long")
    parser.add_argument("--out", type=Path, help="a line of JSON for each; what stands there is not made again")
    options = parser.parse_args()
    rows = [Row(**json.loads(line)) for line in options.out.open()] if options.out and options.out.exists() else []
    known = {(row.layout, row.robot, row.index) for row in rows}
    end = time.monotonic() + 60 * options.minutes
    for index, robot in itertools.product(range(options.episodes), ROBOTS.names()):
        wanted = [name for name in LAYOUTS if (name, robot, index) not in known]
        if not wanted or time.monotonic() > end:
            continue
        rng = random.Random(f"{robot} {options.seed} {index}")
        tasks = [name for name in TASKS.names() if not TASKS.load(name).refusal(ROBOTS.load(robot))]
        config = GenerateConfig(
            task=rng.choice(tasks), robot=robot, variation=rng.choice(("none", "mild", "full")), seed=options.seed,
            fps=rng.choice((10, 15, 20, 30)), width=64, height=48, cameras=("front",), joint_rate="physics",
            video=VideoConfig(codec="jpeg"),
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "good.mcap"
            if not record(config, index, path) or (episode := read_episode(path)) is None:
                continue
            for name in wanted:
                place = Path(folder) / str(len(rows))
                place.mkdir()
                row = Row(layout=name, robot=robot, task=config.task, index=index,
                          settings=f"{config.variation} {config.fps} fps")  # fmt: skip
                rows.append(replace(row, alarms=checked(LAYOUTS[name](episode, place))))
                if rows[-1].alarms:
                    print(json.dumps(asdict(rows[-1])), flush=True)
                if options.out:
                    with options.out.open("a") as file:
                        file.write(json.dumps(asdict(rows[-1])) + "\n")
    for name in LAYOUTS:
        levels = [{alarm[0] for alarm in row.alarms} for row in rows if row.layout == name]
        failed = sum("fail" in level for level in levels)
        print(
            f"{name}: {len(levels)} episodes, {sum(level == {'warn'} for level in levels)} warned of, {failed} failed"
        )


if __name__ == "__main__":
    main()

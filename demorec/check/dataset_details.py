"""Is what the sidecar keeps of each simulated episode what its scene, its rows and its run's config say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from demorec.check.base import Measurement, sidecar_check
from demorec.check.dataset import Dataset, DescribedEpisode
from demorec.check.rows import LinkMatrices, displacement, matrices
from demorec.core.geometry import Array
from demorec.datasets.lerobot.files import column_numbers, read_json, read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.episode.features import STATE
from demorec.episode.scene import SceneCamera
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf

_STARTS = 0.06
"""Metres by which an object may have moved before the first frame: in 0.1 s, while physics settles, it falls 5.5 cm."""
_POSE = 1e-3
"""Metres, and 0.1 m per rad: states are float32."""


@sidecar_check(
    measures="details of the sidecar that an episode's scene, its rows or its run's config contradict",
)
def dataset_details(dataset: Dataset) -> Measurement | None:
    """Task, seed, behaviour, cameras, goals, objects, phases, conditions; the poses of cameras that move."""
    if not (described := dataset.described()):
        return None
    config_path = dataset.path / SIDECAR_DIR / "configs.json"
    configs = read_json(config_path) if config_path.exists() else {}
    poses = dict(_camera_poses(dataset))
    wrong = [
        f"episode {each.number}: {words}"
        for each in described
        for words in (
            *_contradictions(each, dataset.details[each.number], configs),
            *_wrong_poses(dataset, each, poses),
        )
    ]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(described)} episodes")


def _contradictions(each: DescribedEpisode, said: Mapping[str, Any], configs: Mapping[str, Any]) -> Iterator[str]:
    info, scene = each.info, each.info.scene
    expected: dict[str, Any] = {
        "task": info.task,
        "root_seed": info.root_seed,
        "attempt": info.attempt,
        "run_episode_index": info.episode_index,
        "config_digest": info.config_digest,
        "behaviour": sorted(info.behaviour.items()),
    }
    yield from (f"{name} is {said[name]}" for name, value in expected.items() if name in said and said[name] != value)
    if "config_digest" in said and configs.get(said["config_digest"]) != info.config:
        yield "configs.json has another config"
    goals = [(goal.object, goal.onto, scene.world_from_goal(goal).vector()) for goal in scene.goals]
    found = [(row["object"], row["onto"], row["world_from_goal_start"]) for row in said.get("goals", ())]
    if "goals" in said and not _alike(found, goals, 1e-6):
        yield "its goals are others"
    starts = [(body.name, body.world_from_body.vector()[:3]) for body in scene.movable]
    objects = [(row["name"], row["world_from_object_start"][:3]) for row in said.get("objects", ())]
    if "objects" in said and not _alike(sorted(objects), sorted(starts, key=lambda row: row[0]), _STARTS):
        yield "its objects start elsewhere"
    cameras = [_described_camera(camera) for camera in scene.cameras]
    names = ("name", "width", "height", "mount", "intrinsics", "mount_from_camera")
    if "cameras" in said and not _alike([[row[name] for name in names] for row in said["cameras"]], cameras, 1e-6):
        yield "its cameras are others"
    edges = [0, *(phase["to"] for phase in each.kept["phases"])]
    if edges[:-1] != [phase["from"] for phase in each.kept["phases"]] or edges[-1] != len(each.rows["index"]):
        yield "its phases leave frames out"
    if said.get("success") and (said.get("failure_phase") or not all(row["passed"] for row in said.get("checks", ()))):
        yield "it is a success that did not pass its conditions"


def _described_camera(camera: SceneCamera) -> list[Any]:
    placed = camera.mount_from_camera.vector()
    return [camera.name, camera.width, camera.height, camera.mount, np.ravel(camera.intrinsics), placed]


def _alike(found: Any, expected: Any, tolerance: float) -> bool:
    """Whether nested rows are the same, numbers to a tolerance."""
    if isinstance(expected, list | tuple):
        pairs = zip(found, expected, strict=False)
        return len(found) == len(expected) and all(_alike(*pair, tolerance) for pair in pairs)
    if isinstance(expected, np.ndarray):
        values = np.asarray(found, dtype=np.float64)
        return values.shape == expected.shape and bool(np.abs(values - expected).max(initial=0.0) <= tolerance)
    return bool(found == expected)


def _camera_poses(dataset: Dataset) -> Iterator[tuple[int, Mapping[str, Array]]]:
    """(episode, (camera -> (T, 7) world_from_camera, and frame_index (T, 1))) of the cameras that move."""
    for path in sorted((dataset.path / SIDECAR_DIR / "camera_poses").glob("*/*.parquet")):
        table = read_table(path)
        columns = {name: column_numbers(table.column(name).combine_chunks()) for name in table.column_names}
        episodes = columns.pop("episode_index")[:, 0]
        for number in np.unique(episodes).tolist():
            yield number, {name: values[episodes == number] for name, values in columns.items()}


def _wrong_poses(
    dataset: Dataset, each: DescribedEpisode, poses_of: Mapping[int, Mapping[str, Array]]
) -> Iterator[str]:
    """Poses of moving cameras that forward kinematics of the rows contradicts."""
    info, state = each.info, each.rows[STATE].astype(np.float64)
    moving = [camera for camera in info.scene.cameras if camera.mount != "world"]
    if not moving or dataset.state_kind(info) is None:
        return
    if (poses := poses_of.get(each.number)) is None:
        yield "the poses of its moving cameras are missing"
        return
    if not np.array_equal(poses["frame_index"][:, 0], np.arange(len(state))):
        yield "the poses of its cameras are not those of its frames"
        return
    model = dataset.robot_digests[each.number]
    urdf = Urdf.load(asset_path(info.robot.urdf), scale=info.scene.robot.scale)
    urdf = urdf if model is None else dataset.robots[model].model
    joints = dict(zip(info.robot.arm_joints, state.T, strict=False))
    links = LinkMatrices(urdf, joints, len(state))
    base = info.scene.robot.world_from_base.matrix()
    for camera in moving:
        expected = base @ links[camera.mount] @ camera.mount_from_camera.matrix()
        off = displacement(matrices(poses[camera.name]), expected)
        if not off.max() <= _POSE:
            frame = int(off.argmax())
            yield f"camera {camera.name} is {off[frame]:.3g} m from where the joints take it at frame {frame}"

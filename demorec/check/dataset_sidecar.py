"""Is what demorec keeps beside a dataset (sidecar, facts, progress) what its rows, scenes and run's config say."""

from __future__ import annotations

import reprlib
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from demorec.check.base import Measurement, counted, dataset_check, sidecar_check
from demorec.check.dataset import Dataset, DescribedEpisode
from demorec.check.rows import displacement, matrices
from demorec.core.errors import ExportError, without_path
from demorec.core.geometry import Array
from demorec.datasets.lerobot.facts import (
    PROGRESS_PATH,
    STAGE_COLUMNS,
    facts_after,
    facts_before,
    facts_of,
    first_goal,
    progress_table,
    read_progress,
)
from demorec.datasets.lerobot.files import column_numbers, open_table, read_json, read_table, tables_in
from demorec.datasets.lerobot.inspect import episode_digests
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.robots import read_robot
from demorec.episode.episode import SuccessCheck
from demorec.episode.features import ACTION, ENVIRONMENT_STATE, IMAGE_PREFIX, STATE, observation_names
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import SceneCamera

_STARTS = 0.06
"""Metres by which an object may have moved before the first frame: in 0.1 s, while physics settles, it falls 5.5 cm."""
_POSE = 1e-3
"""Metres, and 0.1 m per rad: states are float32."""
_KEPT = ("success", "failure_phase", "failure_reason", "num_retries")
_ATTEMPT = ("source", "run_episode_index", "attempt", "success", "failure_reason")
_START = ("object", "object_x", "object_y", "goal_x", "goal_y")


@sidecar_check(measures="episodes on which dataset and sidecar disagree")
def dataset_sidecar(dataset: Dataset) -> Measurement | None:
    """Task, success and content digest of each episode are those that the sidecar keeps."""
    if not dataset.sidecar:
        return None
    wrong, known = [], [row["episode_index"] for row in dataset.sidecar]
    if any(number not in range(len(dataset.rows)) for number in known) or sorted(set(known)) != known:
        wrong.append(f"its rows are of the episodes {reprlib.repr(known)}, the dataset has {len(dataset.rows)}")
    elif missing := sorted(set(range(len(dataset.rows))) - set(known)):
        wrong.append(
            f"of episode {', '.join(map(str, missing[:5]))} it knows nothing: LeRobot recorded {len(missing)} of "
            f"{len(dataset.rows)} into the dataset, or its rows were lost"
        )
    if all(number in range(len(dataset.rows)) for number in known):
        infos = {each.number: each.info for each in dataset.described()}
        digests = episode_digests(dataset.path, dataset.info)
        for row in dataset.sidecar:
            number = row["episode_index"]
            rows, info = dataset.rows[number], infos.get(number)
            if info is not None and dataset.places[number].tasks != (info.instruction,):
                wrong.append(f"episode {number} has another instruction")
            elif "next.success" in rows and bool(rows["next.success"][-1, 0]) != row["success"]:
                wrong.append(f"episode {number} has another outcome")
            elif digests[number] != row["content_digest"]:
                wrong.append(f"episode {number} has changed since it was exported")
    return counted(wrong, f"{len(dataset.sidecar)} episodes")


@sidecar_check(measures="statements of info.json that the episodes' own descriptions contradict")
def dataset_description(dataset: Dataset) -> Measurement | None:
    """Robot, rate, names of components and sizes of images are those of the scenes that the sidecar keeps."""
    if not dataset.infos:
        return None
    wrong = [
        f"episode {each.number}: {words}"
        for each in dataset.described()
        for words in _described(dataset, each.info, int(each.kept["frame_stride"]))
    ]
    return counted(wrong, f"{len(dataset.infos)} episodes")


def _described(dataset: Dataset, info: EpisodeInfo, stride: int) -> Iterator[str]:
    features = dataset.info.features
    if dataset.info.robot_type != info.robot.name:
        yield f"robot_type is {dataset.info.robot_type}, the robot was {info.robot.name}"
    if stride < 1 or info.fps != dataset.info.fps * stride:
        yield f"fps is {dataset.info.fps}, every {stride}. of {info.fps} frames a second was taken"
    state = dataset.state_kind(info) or "joint"
    expected = observation_names(info.robot, info.scene, privileged=ENVIRONMENT_STATE in features, state=state)
    for name, names in expected.items():
        if name in features and features[name].names != names:
            yield f"the components of {name} are not those of the robot in their order"
    if ACTION in features and dataset.action_kind(info) is None:
        yield "the components of the action are none that demorec writes"
    for camera in info.scene.cameras:
        feature = features.get(IMAGE_PREFIX + camera.name)
        if feature is not None and feature.shape != (camera.height, camera.width, 3):
            yield f"the camera {camera.name} has {camera.width}x{camera.height} pixels, its feature {feature.shape}"


@sidecar_check(measures="details of the sidecar that an episode's scene, its rows or its run's config contradict")
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
        for words in (*_contradictions(each, configs), *_wrong_poses(dataset, each, poses))
    ]
    return counted(wrong, f"{len(described)} episodes")


def _contradictions(each: DescribedEpisode, configs: Mapping[str, Any]) -> Iterator[str]:
    said, info, scene = each.kept, each.info, each.info.scene
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
    edges = [0, *(phase["to"] for phase in said["phases"])]
    if edges[:-1] != [phase["from"] for phase in said["phases"]] or edges[-1] != len(each.rows["index"]):
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
    for path in tables_in(dataset.path, f"{SIDECAR_DIR}/camera_poses"):
        table = read_table(path)
        columns = {name: column_numbers(table.column(name).combine_chunks()) for name in table.column_names}
        episodes = columns.pop("episode_index")[:, 0]
        for number in np.unique(episodes).tolist():
            yield number, {name: values[episodes == number] for name, values in columns.items()}


def _wrong_poses(
    dataset: Dataset, each: DescribedEpisode, poses_of: Mapping[int, Mapping[str, Array]]
) -> Iterator[str]:
    """Poses of moving cameras that forward kinematics of the rows contradicts."""
    info = each.info
    moving = [camera for camera in info.scene.cameras if camera.mount != "world"]
    if not moving or dataset.state_kind(info) is None:
        return
    if (poses := poses_of.get(each.number)) is None:
        yield "the poses of its moving cameras are missing"
        return
    if not np.array_equal(poses["frame_index"][:, 0], np.arange(len(each.rows[STATE]))):
        yield "the poses of its cameras are not those of its frames"
        return
    links, base = dataset.links(each), info.scene.robot.world_from_base.matrix()
    for camera in moving:
        expected = base @ links[camera.mount] @ camera.mount_from_camera.matrix()
        off = displacement(matrices(poses[camera.name]), expected)
        if not off.max() <= _POSE:
            frame = int(off.argmax())
            yield f"camera {camera.name} is {off[frame]:.3g} m from where the joints take it at frame {frame}"


@sidecar_check(measures="descriptions of robots that are missing, changed or of another robot")
def dataset_robots(dataset: Dataset) -> Measurement | None:
    """The URDF beside each episode is there, unchanged, and of the robot, joints and TCP that the episode has.

    That it is the arm that moved shows in the kinematics: the EE pose follows from it (`dataset_forward_kinematics`).
    """
    named = [row for row in reversed(dataset.sidecar) if row.get("robot_digest")]
    used = {row["robot_digest"]: row["episode_index"] for row in named}
    if not used:
        return None
    wrong, specs = [], {each.number: each.info.robot for each in dataset.described()}
    for name, number in used.items():
        try:
            robot = read_robot(dataset.path, name)
        except ExportError as error:
            wrong.append(without_path(error, dataset.path))
            continue
        if robot.record.name != dataset.info.robot_type:
            wrong.append(f"{name} is of a {robot.record.name}, the dataset of a {dataset.info.robot_type}")
        for feature, joints in robot.record.joints.items():
            there = dataset.info.features.get(feature)
            if there is not None and there.shape != (len(joints),):
                wrong.append(f"{name} has joints for {len(joints)} elements of {feature}, it has {there.shape}")
        spec = specs.get(number)
        if spec is not None and robot.record.spec != spec:  # an episode that was cut has a robot and no scene
            wrong.append(f"{name} is not the robot of episode {number}")
        elif spec is not None and spec.tcp_link not in robot.model.link_poses({}):
            wrong.append(f"the URDF of {name} has no link {spec.tcp_link}")
    return counted(wrong, f"{len(used)} robot{'s' * (len(used) > 1)}")


@sidecar_check(measures="columns of the table of episodes that the sidecar contradicts")
def dataset_facts(dataset: Dataset) -> Measurement | None:
    """Every column by which episodes are chosen is what the sidecar's scene and conditions give, and each episode is
    one of the attempts."""
    names = [name for name in facts_of(dataset.path) if name not in STAGE_COLUMNS]
    if not dataset.sidecar or not names:
        return None
    rows: dict[int, dict[str, Any]] = {}
    for path in tables_in(dataset.path, "meta/episodes"):
        if set(names) <= set(open_table(path).schema_arrow.names):  # LeRobot's own recordings have none of them
            rows.update({row["episode_index"]: row for row in read_table(path, ["episode_index", *names]).to_pylist()})
    wrong = list(_strange_attempts(dataset))
    for each in dataset.described():
        if (row := rows.get(each.number)) is None:
            wrong.append(f"episode {each.number} has none")
            continue
        expected = _expected_facts(dataset, each)
        differing = [name for name in names if name in expected and row[name] != expected[name]]
        wrong += [f"episode {each.number}: {name} is {row[name]}" for name in differing]
    return counted(wrong, f"{len(rows)} episodes")


def _expected_facts(dataset: Dataset, each: DescribedEpisode) -> dict[str, Any]:
    """Those that the sidecar gives; of a recording whose frames were not all taken the duration is not known."""
    kept = each.kept
    facts = {name: kept[name] for name in _KEPT if name in kept} | facts_before(each.info)
    if kept["frame_stride"] == 1:
        facts["duration_s"] = len(each.rows["index"]) / dataset.info.fps
        facts["has_deliberate_miss"] = bool(kept["deliberate_miss_frames"])
    return facts | facts_after(SuccessCheck(**check) for check in kept.get("checks", ()))


def _strange_attempts(dataset: Dataset) -> Iterator[str]:
    """Attempts that are said to be in the dataset, against its episodes; starts and goals of these."""
    paths = tables_in(dataset.path, f"{SIDECAR_DIR}/attempts")
    if not paths or not dataset.sidecar or not all(set(_ATTEMPT) <= row.keys() for row in dataset.sidecar):
        return
    rows = [row for path in paths for row in read_table(path).to_pylist() if row["in_dataset"]]
    told = Counter(tuple(row[name] for name in _ATTEMPT) for row in rows)
    there = Counter(tuple(row[name] for name in _ATTEMPT) for row in dataset.sidecar)
    if len(dataset.sidecar) >= len(rows):  # the sidecar may lack an episode, as after LeRobot's resume
        yield from (f"of the attempts, {key[0]} is no episode" for key in told - there)
    yield from (f"{key[0]} is none of the attempts" for key in there - told)
    starts = Counter(tuple(row[name] for name in _START) for row in rows)
    for each in dataset.described():
        goal = first_goal(each.info.scene)
        if not told - there and starts[tuple(goal[name] for name in _START)] < 1:
            yield f"the attempt of episode {each.number} has another start"


@dataset_check(measures="rows of sarm_progress.parquet that the episodes' stages contradict")
def dataset_progress(dataset: Dataset) -> Measurement | None:
    """Every row of the dataset has a progress in 0 to 1, which is that of its stage; stages leave no gap."""
    path = dataset.path / PROGRESS_PATH
    if not set(STAGE_COLUMNS) <= set(facts_of(dataset.path)) and not path.exists():
        return None
    episodes = read_progress(dataset.path)
    lengths = [
        (episode.runs[-1].last + 1, place.length) for episode, place in zip(episodes, dataset.places, strict=True)
    ]
    if wrong := [number for number, (found, length) in enumerate(lengths) if found != length]:
        return Measurement(value=len(wrong), detail=f"the stages of episode {wrong[0]} do not cover it")
    expected = progress_table(episodes)
    found = read_table(path, expected.column_names)
    if found.num_rows != expected.num_rows:
        return Measurement(value=abs(found.num_rows - expected.num_rows), detail=f"{found.num_rows} rows")
    off = np.zeros(found.num_rows, dtype=np.bool_)
    for name in expected.column_names:
        difference = found.column(name).to_numpy() - expected.column(name).to_numpy()
        off |= ~(np.abs(difference) < 1e-5)
    first = f"row {int(np.argmax(off))}" if off.any() else f"{found.num_rows} rows"
    return Measurement(value=int(off.sum()), detail=first)

"""Is what demorec keeps beside a dataset (sidecar, facts, progress) what its rows, scenes and run's config say."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator

from demorec.check.base import Measurement, counted, sidecar_check
from demorec.check.dataset import Dataset
from demorec.core.errors import ExportError, without_path
from demorec.datasets.lerobot.inspect import episode_digests
from demorec.datasets.lerobot.robots import read_robot
from demorec.episode.features import ACTION, ENVIRONMENT_STATE, IMAGE_PREFIX, observation_names
from demorec.episode.info import EpisodeInfo


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
        f"episode {each.number}: {words}" for each in dataset.described() for words in _described(dataset, each.info)
    ]
    return counted(wrong, f"{len(dataset.infos)} episodes")


def _described(dataset: Dataset, info: EpisodeInfo) -> Iterator[str]:
    features = dataset.info.features
    if dataset.info.robot_type != info.robot.name:
        yield f"robot_type is {dataset.info.robot_type}, the robot was {info.robot.name}"
    if info.fps % dataset.info.fps:
        yield f"fps is {dataset.info.fps}, which does not divide {info.fps}"
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

"""Does a dataset describe the arms that its episodes were made with, as they were described when it was written."""

from __future__ import annotations

from demorec.check.base import Measurement, dataset_check
from demorec.check.dataset import Dataset
from demorec.errors import ExportError, without_path
from demorec.lerobot.robots import read_robot


@dataset_check(
    measures="descriptions of robots that are missing, changed or of another robot",
    reads=("demorec/",),
)
def dataset_robots(dataset: Dataset) -> Measurement | None:
    """The URDF beside each episode is there, unchanged, and of the robot, joints and TCP that the episode has.

    That it is the arm that moved shows in the kinematics: the EE pose follows from it (`dataset_forward_kinematics`).
    """
    used = {name: number for number, name in reversed(dataset.robot_digests.items()) if name is not None}
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
        if robot.record.spec != spec:
            wrong.append(f"{name} is not the robot of episode {number}")
        elif spec is not None and spec.tcp_link not in robot.model.link_poses({}):
            wrong.append(f"the URDF of {name} has no link {spec.tcp_link}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(used)} robot{'s' * (len(used) > 1)}")

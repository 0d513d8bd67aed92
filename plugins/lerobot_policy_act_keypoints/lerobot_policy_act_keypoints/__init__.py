"""ACT over keypoints of images, a policy of LeRobot; its pretraining, and a faster dataset reader.

Importing this package registers the policy type `act_keypoints`. LeRobot's commands do so by themselves.

    configuration_act_keypoints    settings of the policy; modeling_ and processor_ hold what LeRobot finds by name
    pretrain                       trains the image encoder (act-keypoints-pretrain)
    training                       lerobot-train with the faster reader (lerobot-train-fast)
    reader                         the reader itself, `FastDataset`
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lerobot_policy_act_keypoints.configuration_act_keypoints import ActKeypointsConfig

if TYPE_CHECKING:
    from lerobot_policy_act_keypoints.reader import FastDataset

__all__ = ["ActKeypointsConfig", "FastDataset"]


def __getattr__(name: str) -> Any:
    if name != "FastDataset":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lerobot_policy_act_keypoints.reader import FastDataset  # loads LeRobot's datasets, which takes seconds

    return FastDataset

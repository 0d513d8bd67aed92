"""Processing steps of the policy `act_keypoints`: those of ACT. LeRobot finds the function by its name."""

from lerobot.policies.act.processor_act import make_act_pre_post_processors

__all__ = ["make_act_keypoints_pre_post_processors"]

make_act_keypoints_pre_post_processors = make_act_pre_post_processors

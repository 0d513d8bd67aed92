"""LeRobot imports what is called lerobot_robot_*, and so knows demorec's arms."""

from demorec.lerobot_robot import DemorecPanda, DemorecSO101

__all__ = ["DemorecPanda", "DemorecSO101"]

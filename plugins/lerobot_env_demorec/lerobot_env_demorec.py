"""LeRobot imports what is called lerobot_env_*, and so knows demorec's environments."""

from demorec.lerobot_env import DemorecEnvConfig

__all__ = ["DemorecEnvConfig"]

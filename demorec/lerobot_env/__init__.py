"""Makes demorec's environments known to LeRobot's own commands, without a change to LeRobot.

    lerobot-eval --env.discover_packages_path=demorec.lerobot_env --env.type=demorec --env.task=pick_place \
        --policy.path=... --eval.n_episodes=100

Importing this package is all that is needed; `lerobot-train` takes the same flags.
"""

from demorec.lerobot_env.config import DemorecEnvConfig

__all__ = ["DemorecEnvConfig"]

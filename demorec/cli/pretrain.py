"""`demorec pretrain`: the encoder of a policy's pictures learns to see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demorec.cli.shared.output import say, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.core.errors import check_option


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Teach the encoder of an ACT policy's pictures to see, before the policy is trained.

    It learns to tell from the pictures where the hand will be when the gripper is next told to close or to open. That
    is read off the dataset's own poses and commands: no poses of objects are needed. What comes out is a policy folder
    for --policy.path of demorec train. Flags that are not its own are those of lerobot-train, of which the dataset's,
    the policy's and the seed count. A stopped call goes on with the same command.

    Examples:
      demorec pretrain --config_path=examples/act_pictures.json --out outputs/eye
      demorec train --config_path=examples/act_pictures.json \\
          --policy.path=outputs/eye --freeze-encoder
    """

    out: Path
    """Folder of the policy."""
    num_updates: int = 1500
    """Updates of the encoder's weights."""
    frames_per_update: int = 64
    """Frames of each update, with the pictures of all cameras."""
    learning_rate: float = 1e-3
    """At its highest; it falls along a cosine."""
    frame_cache_mb: int = 256
    """Decoded frames that are kept, in MB of 2^20 bytes; a small dataset is then decoded only once."""
    others: tuple[str, ...] = ()
    """Flags of lerobot-train."""

    def run(self) -> int:
        """Teach, and tell what was learnt."""
        check_option("num_updates", self.num_updates, 1, 10_000_000)
        check_option("frames_per_update", self.frames_per_update, 2, 65_536)
        check_option("learning_rate", self.learning_rate, 1e-7, 1.0)
        check_option("frame_cache_mb", self.frame_cache_mb, 0, 1 << 20)
        refuse_inside([self.out])
        from demorec.learn.training.command import training_config

        config = training_config(self.others)
        from demorec.learn.training.pretrain import PretrainConfig, pretrain

        plan = PretrainConfig(
            updates=self.num_updates,
            batch_size=self.frames_per_update,
            learning_rate=self.learning_rate,
            seed=config.seed or 0,
        )
        result = pretrain(
            config,
            plan,
            self.out,
            frame_cache_bytes=self.frame_cache_mb << 20,
            on_progress=lambda done, loss: tell(f"update {done:,} of {plan.updates:,}, loss {loss:.3f}"),
        )
        say(
            f"next keyframe {1000 * result.median_m:.1f} mm off (median; 9 of 10 frames within "
            f"{1000 * result.most_m:.0f} mm) in {result.episodes} episodes left out; unseen, it is "
            f"{1000 * result.baseline_m:.0f} mm",
            f"policy        {self.out}",
        )
        return 0

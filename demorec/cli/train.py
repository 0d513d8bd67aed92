"""`demorec train`: lerobot-train that waits less for its data."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.cli.shared.output import tell


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy with lerobot-train, which reads its dataset by demorec's reader: equal items, in less time.

    Every other flag is lerobot-train's own and goes to it unchanged, see lerobot-train --help; so do checkpoints and
    logs stay what they are. Datasets of others are read as well as those of demorec.

    Examples:
      demorec train --config_path=examples/act_numbers.json
      demorec train --config_path=examples/act_pictures.json \\
          --policy.path=outputs/eye --freeze-encoder
      demorec train --dataset.repo_id=lerobot/pusht --policy.type=diffusion
    """

    frame_cache_mb: int = 256
    """Decoded frames that each process keeps, in MB of 2^20 bytes; a small dataset is then decoded only once."""
    expert_only: bool = False
    """Of corrected episodes (demorec correct, export --intervention) learn from the expert's frames alone."""
    freeze_encoder: bool = False
    """Do not train the encoder of an ACT policy's pictures (demorec pretrain): each picture goes through it once."""
    others: tuple[str, ...] = ()
    """What goes to lerobot-train."""

    def run(self) -> int:
        """Train."""
        from demorec.learn.training.command import train

        replaced = "demorec train: FastDataset reads in place of LeRobotDataset; all else is lerobot-train."
        train(
            self.others,
            frame_cache_bytes=self.frame_cache_mb << 20,
            on_replaced=lambda: tell(replaced),
            expert_only=self.expert_only,
            freeze_encoder=self.freeze_encoder,
        )
        return 0

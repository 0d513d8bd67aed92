"""`demorec train`, `demorec pretrain` and `demorec improve`: policies learn, with lerobot-train."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from demorec.cli.shared.output import say, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.core.errors import ConfigError, check_option
from demorec.learn.evaluate import Plan


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy with lerobot-train and demorec's faster dataset reader, which gives the same items.

    All other flags are passed on to lerobot-train unchanged (see lerobot-train --help); checkpoints and logs are its
    own. Any LeRobot dataset can be read, not only demorec's.

    Examples:
      demorec train --config_path=examples/act_numbers.json
      demorec train --config_path=examples/act_images.json --policy.path=outputs/eye
      demorec train --dataset.repo_id=lerobot/pusht --policy.type=diffusion
    """

    frame_cache_mb: int = 256
    """Cache of decoded frames in each process, in MiB; a small dataset is then decoded only once."""
    expert_only: bool = False
    """In corrected episodes (demorec correct, export --intervention), learn from the expert's frames only."""
    others: tuple[str, ...] = ()
    """Flags for lerobot-train."""

    def run(self) -> int:
        """Train."""
        from demorec.learn.training.command import train

        replaced = "demorec train: FastDataset reads in place of LeRobotDataset; all else is lerobot-train."
        train(
            self.others,
            frame_cache_bytes=self.frame_cache_mb << 20,
            on_replaced=lambda: tell(replaced),
            expert_only=self.expert_only,
        )
        return 0


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Pretrain the image encoder of a policy of type act_keypoints before the policy is trained.

    From the images, it learns to predict where the hand will be when the gripper is next commanded to close, and when
    it is next commanded to open. The targets come from the dataset's own poses and commands; no object poses are
    needed. The result is a policy folder for --policy.path of demorec train. All other flags are those of
    lerobot-train, of which only those about the dataset, the policy and the seed matter. Run the same command again to
    continue where it stopped.

    Examples:
      demorec pretrain --config_path=examples/act_images.json --out outputs/eye
      demorec train --config_path=examples/act_images.json --policy.path=outputs/eye
    """

    out: Path
    """Folder of the policy."""
    num_updates: int = 3000
    """Number of updates of the encoder's weights."""
    frames_per_update: int = 64
    """Frames per update, each with the images of all cameras."""
    learning_rate: float = 2e-3
    """Peak learning rate; it decays along a cosine."""
    frame_cache_mb: int = 256
    """Cache of decoded frames, in MiB; a small dataset is then decoded only once."""
    others: tuple[str, ...] = ()
    """Flags for lerobot-train."""

    def run(self) -> int:
        """Train the encoder and report how well it predicts."""
        check_option("num_updates", self.num_updates, 1, 10_000_000)
        check_option("frames_per_update", self.frames_per_update, 2, 65_536)
        check_option("learning_rate", self.learning_rate, 1e-7, 1.0)
        check_option("frame_cache_mb", self.frame_cache_mb, 0, 1 << 20)
        if steps := next((flag for flag in self.others if flag.partition("=")[0] == "--steps"), ""):
            raise ConfigError(f"{steps} is for demorec train: --num-updates says how long the encoder learns.")
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
            on_progress=tell,
        )
        say(
            f"next keyframe {1000 * result.median_m:.1f} mm off (median; 9 of 10 frames within "
            f"{1000 * result.most_m:.0f} mm) in {result.episodes} held-out episodes; without images "
            f"{1000 * result.baseline_m:.0f} mm",
            f"policy        {self.out}",
        )
        return 0


@dataclass(frozen=True, kw_only=True)
class Improve(Plan):
    """Train a policy, let the expert correct it where it strays, and train again on everything, in rounds.

    Round 0 learns from the demonstrations alone. In each later round, the policy of the round before acts in new
    scenes, the expert takes over (see demorec correct), and a new policy learns from the demonstrations and from the
    expert's corrections of all rounds. Each policy is evaluated on held-out scenes. Run the same command again to
    continue where it stopped. All other flags are passed on to lerobot-train.

    Examples:
      demorec improve recordings/cubes --config-path examples/act_numbers.json \\
          --privileged --features observation.environment_state
      demorec improve recordings/cubes --config-path my.json --steps=2000
    """

    demonstrations: Positional[Path]
    """A run of generate-dataset with --split train, which excludes the held-out scenes."""
    out: Path = Path("outputs/improve")
    """Folder for the rounds."""
    workers: int | None = None
    """Processes that simulate (auto: one per core)."""
    others: tuple[str, ...] = ()
    """Flags for lerobot-train."""

    def run(self) -> int:
        """Go through the rounds and report."""
        self.validate()
        check_option("workers", self.workers, 1, 1024)
        refuse_inside([self.out])
        from demorec.core.processes import available_cores
        from demorec.learn.evaluate.improvement import Improvement

        improvement = Improvement(
            self,
            self.out,
            demonstrations=self.demonstrations,
            words=self.others,
            workers=self.workers or available_cores(),
            tell=tell,
        )
        rounds = list(improvement.rounds())
        say(
            f"{'round':>5} {'demonstrations':>15} {'corrected':>10} {'training CPU s':>15}  success (Wilson 95 %)",
            *(
                f"{r.number:>5} {r.demonstrations:>15} {r.corrections:>10} {r.cpu_seconds:>15.0f}  {r.rate}"
                for r in rounds
            ),
            "",
            f"policy        {self.out / f'round_{self.num_rounds:02d}' / 'train'}",
        )
        return 0

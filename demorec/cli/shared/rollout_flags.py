"""What commands that let a policy act have in common: which policy, in which scenes, recorded how."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from demorec.cli.shared.allow import Allow, allowed_modules
from demorec.cli.shared.paths import refuse_inside
from demorec.cli.shared.progress import ProgressBar
from demorec.core.config import GenerateConfig, VideoConfig
from demorec.core.errors import check_option

if TYPE_CHECKING:
    from demorec.learn.evaluate.moments import TakeOver
    from demorec.learn.evaluate.rollouts import Evaluation

Split = Literal["all", "train", "eval"]


@dataclass(frozen=True, kw_only=True)
class RolloutFlags:
    """The flags; a command that derives from this has its own default of `split`."""

    policy: Path | None = None
    """Output folder of lerobot-train, or a pretrained_model folder."""
    task: str = "pick_place"
    """A name of `demorec list tasks`, or my_package.my_module:MyTask."""
    robot: str = "panda"
    """A name of `demorec list robots`, or my_package.my_module:MY_ARM."""
    cameras: tuple[str, ...] = ()
    """Those of your own that the policy sees, as my_package.my_module:MY_CAMERA; it names the others itself."""
    num_episodes: int = 50
    """How many scenes."""
    seed: int = 0
    """Root of the scenes; with another split than eval take another one than the dataset's."""
    out: Path | None = None
    """Folder of the results (auto: one for each task)."""
    action: str | None = None
    """joint, joint_increment, ee or ee_delta (auto: as in the dataset that the policy was trained on)."""
    action_steps: int | None = None
    """Actions that are executed before the policy looks again (auto: as trained)."""
    episode_length: int | None = None
    """Time limit in frames (auto: 15 s for each object to be moved)."""
    fps: int = 30
    """Frames per second, those of the dataset."""
    variation: Literal["none", "mild", "full"] = "mild"
    """How much the scenes differ, as of generate-dataset."""
    renderer: str | None = None
    """For a policy that looks at pictures (auto: that of generate-dataset)."""
    video: VideoConfig = field(default_factory=VideoConfig)
    """Coding of the recorded pictures."""
    workers: int | None = None
    """Processes (auto: one for each core)."""
    allow: Allow = ()
    """A module or package of your own that may be imported for the cameras and steps that the policy names."""
    overwrite: bool = False
    """Delete what the same command made in the output folder, and begin anew."""
    split: Split = "eval"
    """As of generate-dataset."""

    def carry_out(self, policy: Path, out: Path, *, title: str, takeover: TakeOver | None = None) -> Evaluation:
        """Let a policy act in every scene; the recordings go to `out`."""
        check_option("num_episodes", self.num_episodes, 1, 1_000_000)
        if self.workers is not None:
            check_option("workers", self.workers, 1, 1024)
        refuse_inside([out])
        from demorec.core.processes import available_cores
        from demorec.core.registry import check_choice
        from demorec.learn.evaluate.rollouts import evaluate, settings_for
        from demorec.loop.actions import ACTION_KINDS

        settings = settings_for(
            policy,
            self._config(),
            action=None if self.action is None else check_choice("action", self.action, ACTION_KINDS),
            action_steps=self.action_steps,
            episode_length=self.episode_length,
            allowed=allowed_modules(self.allow),
        )
        workers = self.workers or available_cores()
        with ProgressBar(title, total=self.num_episodes, unit="rollout", at_once=workers) as bar:

            def progress(evaluation: Evaluation) -> None:
                bar.note(str(evaluation.rate))
                bar.set(len(evaluation.rollouts))

            return evaluate(
                replace(settings, takeover=takeover),
                out,
                num_episodes=self.num_episodes,
                workers=workers,
                overwrite=self.overwrite,
                progress=progress,
            )

    def _config(self) -> GenerateConfig:
        plain: dict[str, Any] = {} if self.renderer is None else {"renderer": self.renderer}
        return GenerateConfig(
            task=self.task,
            robot=self.robot,
            split=self.split,
            seed=self.seed,
            fps=self.fps,
            cameras=self.cameras,
            variation=self.variation,
            video=self.video,
            **plain,
        )

"""`demorec evaluate`: what a policy learned, in closed loop."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from demorec.cli.allow import Allow, allowed_modules
from demorec.cli.output import say, say_json
from demorec.cli.paths import refuse_inside
from demorec.cli.progress import ProgressBar
from demorec.config import GenerateConfig, VideoConfig
from demorec.errors import ConfigError, check_option

if TYPE_CHECKING:
    from demorec.evaluate.rollouts import Evaluation
    from demorec.evaluate.statistics import Comparison


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Run a policy that LeRobot saved over held-out scenes: success rate, where it fails, every rollout recorded.

    Success is the task's own strict conditions, held for five frames. The same command again goes on where it
    stopped. The scenes are those of lerobot-eval with --env.split and --env.scene_seed, numbered from 0 here and from
    its --seed there.

    Examples:
      demorec evaluate --policy outputs/train --task pick_place --num-episodes 100
      demorec evaluate --policy outputs/train --split all --seed 1 --out all
      demorec evaluate --compare evaluations/clean evaluations/noisy
      demorec view evaluations/clean/failed            (watch the failures)
    """

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
    split: Literal["all", "train", "eval"] = "eval"
    """eval: scenes and seeds that --split train leaves out; all or train: as generate-dataset makes them."""
    seed: int = 0
    """Root of the scenes; with another split than eval take another one than the dataset's."""
    out: Path | None = None
    """Folder of the results (auto: evaluations/TASK)."""
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
    """Delete the evaluation that the output folder holds, and begin anew."""
    compare: tuple[Path, Path] | None = None
    """Compare two finished evaluations instead: FOLDER FOLDER."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Evaluate or compare, and tell."""
        if self.compare is not None:
            return self._compare(*self.compare)
        if self.policy is None:
            raise ConfigError("Nothing to evaluate: give --policy FOLDER, or --compare FOLDER FOLDER.")
        check_option("num_episodes", self.num_episodes, 1, 1_000_000)
        if self.workers is not None:
            check_option("workers", self.workers, 1, 1024)
        from demorec.evaluate.rollouts import evaluate, settings_for
        from demorec.generate.options import available_cores
        from demorec.loop.actions import check_action_kind

        settings = settings_for(
            self.policy,
            self._config(),
            action=None if self.action is None else check_action_kind(self.action),
            action_steps=self.action_steps,
            episode_length=self.episode_length,
            allowed=allowed_modules(self.allow),
        )
        out = self.out or Path("evaluations") / self.task.rpartition(":")[2]
        refuse_inside([out])
        with ProgressBar("evaluating", total=self.num_episodes, unit="rollout") as bar:

            def progress(evaluation: Evaluation) -> None:
                bar.note(str(evaluation.rate))
                bar.set(len(evaluation.rollouts))

            evaluation = evaluate(
                settings,
                out,
                num_episodes=self.num_episodes,
                workers=self.workers or available_cores(),
                overwrite=self.overwrite,
                progress=progress,
            )
        if self.json:
            say_json(_plain(evaluation))
        else:
            say(*_told(evaluation, out))
        return 0

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

    def _compare(self, first: Path, second: Path) -> int:
        from demorec.evaluate.rollouts import load_evaluation
        from demorec.evaluate.statistics import compare

        a, b = load_evaluation(first), load_evaluation(second)
        scenes_a, scenes_b = a.settings.config, b.settings.config
        for name in ("task", "robot", "split", "seed", "variation"):
            there, here = getattr(scenes_a, name), getattr(scenes_b, name)
            if there != here:
                raise ConfigError(f"The two were not tried on the same scenes: {name} is {there} and {here}.")
        comparison = compare(a.successes, b.successes)
        if self.json:
            say_json(asdict(comparison))
        else:
            say(*_compared(comparison, first, second))
        return 0


def _told(evaluation: Evaluation, out: Path) -> list[str]:
    from collections import Counter

    from demorec.evaluate.statistics import cells

    settings = evaluation.settings
    lines = [
        f"policy        {settings.policy_type} {settings.policy_digest}, action {settings.action}",
        f"scenes        {settings.config.task}, split {settings.config.split}, seed {settings.config.seed}",
        f"success       {evaluation.rate} (Wilson 95 %)",
    ]
    lengths = sorted(r.num_frames for r in evaluation.rollouts if r.success)
    if lengths:
        lines.append(f"median length {lengths[len(lengths) // 2] / settings.config.fps:.1f} s of the successes")
    failures = Counter(f"{r.phase}: {r.reason}" for r in evaluation.rollouts if not r.success)
    for number, (reason, count) in enumerate(failures.most_common()):
        lines.append(f"{'failures' if number == 0 else '':<13} {count:>4}  {reason}")
    lines += ["", f"{'by cell':<20} {'range':<20} success (Wilson 95 %)"]
    for cell in cells(evaluation.factors, [r.success for r in evaluation.rollouts]):
        lines.append(f"{cell.factor:<20} {f'{cell.low:.3f} .. {cell.high:.3f}':<20} {cell.rate}")
    return [*lines, "", f"recordings    {out / 'episodes'}, {out / 'failed'}"]


def _plain(evaluation: Evaluation) -> dict[str, Any]:
    from demorec.evaluate.statistics import cells
    from demorec.plain import to_plain

    plain: dict[str, Any] = to_plain(evaluation)
    plain["success_rate"] = evaluation.rate.value
    plain["interval"] = list(evaluation.rate.interval)
    plain["cells"] = to_plain(cells(evaluation.factors, [r.success for r in evaluation.rollouts]))
    return plain


def _compared(comparison: Comparison, first: Path, second: Path) -> list[str]:
    low, high = (100 * bound for bound in comparison.interval)
    alone = f"{comparison.only_first} scenes by the first, {comparison.only_second} by the second"
    return [
        f"first         {comparison.first}   {first}",
        f"second        {comparison.second}   {second}",
        f"difference    {100 * comparison.difference:+.1f} points [{low:+.1f}, {high:+.1f}] (Newcombe 95 %)",
        f"one alone     {alone} (McNemar, exact: p = {comparison.p_value:.3g})",
    ]

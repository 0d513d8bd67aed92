"""`demorec evaluate` and `demorec correct`: run a policy in closed loop, alone or with the expert as fallback."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from demorec.cli.shared.flags import Allow, allowed_modules
from demorec.cli.shared.output import ProgressBar, say, say_json
from demorec.cli.shared.paths import refuse_inside
from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, check_option
from demorec.core.options import Rare
from demorec.core.replacing import OptionalTarget
from demorec.extensions.policies.takeover import TakeOver

if TYPE_CHECKING:
    from demorec.extensions.policies.evaluation import Evaluation


Split = Literal["all", "train", "eval"]
_SCENES = ("task", "robot", "objects", "object_split", "split", "seed", "variation")
"""Options of `GenerateConfig` that decide the scenes."""


@dataclass(frozen=True, kw_only=True)
class RolloutFlags:
    """Policy, scenes and recording options; each command has its own default of `split`."""

    policy: Path | None = None
    """Output folder of lerobot-train, or a pretrained_model folder."""
    task: str = "pick_place"
    """A name from `demorec list tasks`, or my_package.my_module:MyTask."""
    robot: str = "panda"
    """A name from `demorec list robots`, or my_package.my_module:MY_ARM."""
    objects: Rare[tuple[str, ...]] = ()
    """Shelves that the task draws from, as in generate-dataset."""
    object_split: Rare[Split] = "all"
    """Shapes of the shelves: eval has those that generate-dataset --object-split train leaves out."""
    cameras: tuple[str, ...] = ()
    """Your own cameras that the policy sees, as my_package.my_module:MY_CAMERA; it names the others itself."""
    num_episodes: int = 50
    """Number of scenes."""
    seed: int = 0
    """Root seed of the scenes; unless --split is eval, choose another one than the dataset's."""
    out: OptionalTarget = None
    """Folder for the results (auto: one per task)."""
    action: str | None = None
    """joint, joint_increment, ee or ee_delta (auto: as in the dataset that the policy was trained on)."""
    action_steps: Rare[int | None] = None
    """Actions to execute before the policy is queried again (auto: as trained)."""
    episode_length: Rare[int | None] = None
    """Time limit in frames (auto: 15 s per object to be moved)."""
    fps: int = 30
    """Frames per second, as in the dataset."""
    variation: Literal["none", "mild", "full"] = "mild"
    """How much the scenes vary, as in generate-dataset."""
    renderer: Rare[str | None] = None
    """Renderer for a policy that uses images (auto: that of generate-dataset)."""
    workers: int | None = None
    """Processes (auto: one per core)."""
    allow: Rare[Allow] = ()
    """A module or package of your own that may be imported for the cameras and steps that the policy names."""
    overwrite: bool = False
    """Delete this command's earlier results in the output folder and start again."""
    split: Split = "eval"
    """As in generate-dataset."""

    def carry_out(self, policy: Path, out: Path, *, title: str, takeover: TakeOver | None = None) -> Evaluation:
        """Run the policy in every scene and record to `out`."""
        check_option("num_episodes", self.num_episodes, 1, 1_000_000)
        check_option("workers", self.workers, 1, 1024)
        refuse_inside([out])
        from demorec.core.processes import available_cores
        from demorec.core.registry import check_choice
        from demorec.extensions.policies.rollouts import evaluate, settings_for
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
        with ProgressBar(title, total=self.num_episodes, unit="rollout") as bar:

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
        names = (*_SCENES, "fps", "cameras", "renderer")
        values: dict[str, Any] = {name: getattr(self, name) for name in names}
        return GenerateConfig(**{name: value for name, value in values.items() if value is not None})


@dataclass(frozen=True, kw_only=True)
class Evaluate(RolloutFlags):
    """Run a policy saved by LeRobot in held-out scenes; report its success rate and failures, and record every rollout.

    An episode succeeds when the task's own strict conditions hold for five frames. Run the same command again to
    continue where it stopped. The scenes are those of lerobot-eval with --env.split and --env.scene_seed; they are
    numbered from 0 here and from its --seed there.

    Examples:
      demorec evaluate --policy outputs/train --task pick_place --num-episodes 100
      demorec evaluate --policy outputs/train --split all --seed 1 --out all
      demorec view evaluations/pick_place/failed       (watch the failures)
    """

    split: Split = "eval"
    """eval: scenes and seeds that --split train excludes; all or train: as generate-dataset makes them."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Evaluate and report."""
        if self.policy is None:
            raise ConfigError("Nothing to evaluate: give --policy FOLDER.")
        out = self.out or Path("evaluations") / self.task.rpartition(":")[2]
        evaluation = self.carry_out(self.policy, out, title="evaluating")
        if self.json:
            from demorec.core.plain import to_plain

            rate = evaluation.rate
            say_json({**to_plain(evaluation), "success_rate": rate.value, "interval": list(rate.interval)})
        else:
            say(*_evaluation_lines(evaluation, out))
        return 0


def _evaluation_lines(evaluation: Evaluation, out: Path) -> Iterator[str]:
    settings = evaluation.settings
    yield f"policy        {settings.policy_type} {settings.policy_digest}, action {settings.action}"
    yield f"scenes        {settings.config.task}, split {settings.config.split}, seed {settings.config.seed}"
    yield f"success       {evaluation.rate} (Wilson 95 %)"
    lengths = sorted(r.num_frames for r in evaluation.rollouts if r.success)
    if lengths:
        yield f"median length {lengths[len(lengths) // 2] / settings.config.fps:.1f} s of the successes"
    yield from _counts("failures", (f"{r.phase}: {r.reason}" for r in evaluation.rollouts if not r.success))
    yield f"recordings    {out / 'episodes'}, {out / 'failed'}"


def _counts(title: str, reasons: Iterable[str]) -> Iterator[str]:
    for number, (reason, count) in enumerate(Counter(reasons).most_common()):
        yield f"{title if number == 0 else '':<13} {count:>4}  {reason}"


@dataclass(frozen=True, kw_only=True)
class Correct(RolloutFlags):
    """Let a policy act until it strays, then let the scripted expert finish: demonstrations that the policy lacks.

    The expert takes over when the policy strays from the expert's trajectory, gets stuck or runs out of time. It
    stops the arm, brings a held object to its goal or releases it, and finishes the task. Every episode is one
    recording, in which the phase "policy" marks the policy's frames; it can be replayed like any other. Run the same
    command again to continue where it stopped.

    Examples:
      demorec correct --policy outputs/train --num-episodes 100 --seed 1 --out fix1
      demorec correct --policy outputs/train --stray-metres 0.1
      demorec export lerobot fix1 --out data/fix1 --intervention --corrected-only
    """

    split: Split = "train"
    """train or all: scenes as generate-dataset makes them (with another --seed than the dataset's); eval: held out."""
    takeover: TakeOver = field(default_factory=TakeOver)
    """When the expert takes over."""

    def run(self) -> int:
        """Let both act, and report."""
        if self.policy is None:
            raise ConfigError("Missing the policy to correct: give --policy FOLDER.")
        self.takeover.validate()
        out = self.out or Path("corrections") / self.task.rpartition(":")[2]
        evaluation = self.carry_out(self.policy, out, title="correcting", takeover=self.takeover)
        say(*_correction_lines(evaluation, out))
        return 0


def _correction_lines(evaluation: Evaluation, out: Path) -> Iterator[str]:
    from demorec.extensions.policies.turns import read_takeover

    config = evaluation.settings.config
    reasons = [read_takeover(out / rollout.file) for rollout in evaluation.rollouts]
    yield f"policy        {evaluation.settings.policy_type} {evaluation.settings.policy_digest}"
    yield f"scenes        {config.task}, split {config.split}, seed {config.seed}"
    yield f"by itself     {reasons.count('')} of {len(reasons)} episodes"
    yield from _counts("taken over", filter(None, reasons))
    yield f"success       {evaluation.rate} (Wilson 95 %) in the end"
    yield f"recordings    {out / 'episodes'}, {out / 'failed'}"

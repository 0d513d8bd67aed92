"""`demorec evaluate`: what a policy learned, in closed loop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.cli.shared.output import say, say_json
from demorec.cli.shared.rollout_flags import RolloutFlags, Split
from demorec.core.errors import ConfigError

if TYPE_CHECKING:
    from demorec.learn.evaluate.rollouts import Evaluation
    from demorec.learn.evaluate.statistics import RateComparison


@dataclass(frozen=True, kw_only=True)
class Evaluate(RolloutFlags):
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

    split: Split = "eval"
    """eval: scenes and seeds that --split train leaves out; all or train: as generate-dataset makes them."""
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
        out = self.out or Path("evaluations") / self.task.rpartition(":")[2]
        evaluation = self.carry_out(self.policy, out, title="evaluating")
        if self.json:
            say_json(_plain(evaluation))
        else:
            say(*_told(evaluation, out))
        return 0

    def _compare(self, first: Path, second: Path) -> int:
        from demorec.learn.evaluate.rollouts import load_evaluation
        from demorec.learn.evaluate.statistics import compare

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


def _told(evaluation: Evaluation, out: Path) -> Iterator[str]:
    from demorec.learn.evaluate.statistics import cells

    settings = evaluation.settings
    yield f"policy        {settings.policy_type} {settings.policy_digest}, action {settings.action}"
    yield f"scenes        {settings.config.task}, split {settings.config.split}, seed {settings.config.seed}"
    yield f"success       {evaluation.rate} (Wilson 95 %)"
    lengths = sorted(r.num_frames for r in evaluation.rollouts if r.success)
    if lengths:
        yield f"median length {lengths[len(lengths) // 2] / settings.config.fps:.1f} s of the successes"
    failures = Counter(f"{r.phase}: {r.reason}" for r in evaluation.rollouts if not r.success)
    for number, (reason, count) in enumerate(failures.most_common()):
        yield f"{'failures' if number == 0 else '':<13} {count:>4}  {reason}"
    yield from ("", f"{'by cell':<20} {'range':<20} success (Wilson 95 %)")
    for cell in cells(evaluation.factors, [r.success for r in evaluation.rollouts]):
        yield f"{cell.factor:<20} {f'{cell.low:.3f} .. {cell.high:.3f}':<20} {cell.rate}"
    yield from ("", f"recordings    {out / 'episodes'}, {out / 'failed'}")


def _plain(evaluation: Evaluation) -> dict[str, Any]:
    from demorec.core.plain import to_plain
    from demorec.learn.evaluate.statistics import cells

    plain: dict[str, Any] = to_plain(evaluation)
    plain["success_rate"] = evaluation.rate.value
    plain["interval"] = list(evaluation.rate.interval)
    plain["cells"] = to_plain(cells(evaluation.factors, [r.success for r in evaluation.rollouts]))
    return plain


def _compared(comparison: RateComparison, first: Path, second: Path) -> list[str]:
    low, high = (100 * bound for bound in comparison.interval)
    alone = f"{comparison.only_first} scenes by the first, {comparison.only_second} by the second"
    return [
        f"first         {comparison.first}   {first}",
        f"second        {comparison.second}   {second}",
        f"difference    {100 * comparison.difference:+.1f} points [{low:+.1f}, {high:+.1f}] (Newcombe 95 %)",
        f"one alone     {alone} (McNemar, exact: p = {comparison.p_value:.3g})",
    ]

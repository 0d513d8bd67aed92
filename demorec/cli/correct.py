"""`demorec correct`: the expert takes over where a policy strays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.output import say
from demorec.cli.shared.rollout_flags import RolloutFlags, Split
from demorec.core.errors import ConfigError
from demorec.learn.evaluate.moments import TakeOver

if TYPE_CHECKING:
    from demorec.learn.evaluate.rollouts import Evaluation


@dataclass(frozen=True, kw_only=True)
class Correct(RolloutFlags):
    """Let a policy act until it strays, and the scripted expert finish from there: demonstrations of what it lacks.

    The expert takes over when the policy strays from what the expert would do, is stuck, has had its time, or at a
    random moment. It stops the arm, brings what the hand holds to its goal or opens it, and does what is left of the
    task, or hands back. Every episode is one recording, in which the phase "policy" says who acted; it replays like any
    other. The same command again goes on where it stopped. demorec improve does it in rounds with trainings.

    Examples:
      demorec correct --policy outputs/train --num-episodes 100 --seed 1 --out fix1
      demorec correct --policy outputs/train --stray-metres 0.1 --hand-back
      demorec export lerobot fix1 --out data/fix1 --intervention --corrected-only
    """

    split: Split = "train"
    """train and all: scenes as generate-dataset makes them, take another --seed than the dataset's; eval: held out."""
    takeover: TakeOver = field(default_factory=TakeOver)
    """When the expert takes over."""

    def run(self) -> int:
        """Let both act, and tell."""
        if self.policy is None:
            raise ConfigError("There is no policy to correct: give --policy FOLDER.")
        self.takeover.validate()
        out = self.out or Path("corrections") / self.task.rpartition(":")[2]
        evaluation = self.carry_out(self.policy, out, title="correcting", takeover=self.takeover)
        say(*_told(evaluation, out))
        return 0


def _told(evaluation: Evaluation, out: Path) -> Iterator[str]:
    from demorec.learn.evaluate.correction import read_takeover

    config = evaluation.settings.config
    found = [read_takeover(out / rollout.file) for rollout in evaluation.rollouts]
    reasons = Counter(reason for taken in found if taken is not None for reason in taken.reasons)
    frames = sum(taken.num_frames for taken in found if taken is not None)
    total = sum(rollout.num_frames for rollout in evaluation.rollouts)
    yield f"policy        {evaluation.settings.policy_type} {evaluation.settings.policy_digest}"
    yield f"scenes        {config.task}, split {config.split}, seed {config.seed}"
    yield f"by itself     {sum(taken is None for taken in found)} of {len(found)} episodes"
    for number, (reason, count) in enumerate(reasons.most_common()):
        yield f"{'taken over' if number == 0 else '':<13} {count:>4}  {reason}"
    yield f"success       {evaluation.rate} (Wilson 95 %) in the end"
    yield f"expert acted  {frames} of {total} frames"
    yield f"recordings    {out / 'episodes'}, {out / 'failed'}"

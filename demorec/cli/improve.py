"""`demorec improve`: train, correct, train again."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from tyro.conf import Positional

from demorec.cli.shared.output import say, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.core.errors import check_option
from demorec.learn.evaluate.moments import TakeOver


@dataclass(frozen=True, kw_only=True)
class Improve:
    """Train a policy, let the expert correct it where it strays, and train it again on everything, in rounds.

    Round 0 learns from the demonstrations alone. In every further one the policy of the round before acts in new
    scenes, the expert takes over (see demorec correct), and a new policy learns from the demonstrations and from what
    the expert did in all rounds. Each policy is tried on held-out scenes. What a stopped call has left is used: the
    same command goes on. Flags that are not its own go to lerobot-train.

    Examples:
      demorec improve recordings/cubes --config-path examples/act_numbers.json \\
          --privileged --features observation.environment_state
      demorec improve recordings/cubes --config-path my.json --steps=2000
    """

    demonstrations: Positional[Path]
    """A run of generate-dataset with --split train, so that its scenes are not the held-out ones."""
    config_path: Path
    """Settings for lerobot-train, a JSON file; dataset, output folder and seed of it are replaced."""
    num_rounds: int = 2
    """Rounds of corrections."""
    num_episodes: int = 50
    """Scenes of each round in which the policy is corrected."""
    num_scenes: int = 50
    """Held-out scenes on which each policy is tried."""
    seed: int = 1
    """Of the trainings; the scenes of round k have the root seed of the demonstrations plus SEED + k."""
    action: str = "joint_increment"
    """joint, joint_increment, ee or ee_delta."""
    state: str = "joint"
    """joint or joint_ee, as of demorec export lerobot."""
    privileged: bool = False
    """As of demorec export lerobot: let the policy see observation.environment_state."""
    features: tuple[str, ...] = ()
    """As of demorec export lerobot: which features the policy learns from; all by default."""
    takeover: TakeOver = field(default_factory=TakeOver)
    """When the expert takes over."""
    out: Path = Path("outputs/improve")
    """Folder of the rounds."""
    workers: int | None = None
    """Processes that simulate (auto: one for each core)."""
    others: tuple[str, ...] = ()
    """What goes to lerobot-train."""

    def run(self) -> int:
        """Go through the rounds, and tell."""
        check_option("num_rounds", self.num_rounds, 0, 1000)
        check_option("num_episodes", self.num_episodes, 1, 1_000_000)
        check_option("num_scenes", self.num_scenes, 1, 1_000_000)
        if self.workers is not None:
            check_option("workers", self.workers, 1, 1024)
        self.takeover.validate()
        refuse_inside([self.out])
        from demorec.core.processes import available_cores
        from demorec.core.registry import check_choice
        from demorec.episode.features import STATE_KINDS
        from demorec.learn.evaluate.improvement import Improvement, Plan
        from demorec.loop.actions import ACTION_KINDS

        plan = Plan(
            demonstrations=self.demonstrations,
            config_path=self.config_path,
            words=self.others,
            num_rounds=self.num_rounds,
            num_episodes=self.num_episodes,
            num_scenes=self.num_scenes,
            seed=self.seed,
            action=check_choice("action", self.action, ACTION_KINDS),
            state=check_choice("state", self.state, STATE_KINDS),
            privileged=self.privileged,
            features=self.features,
            takeover=self.takeover,
        )
        improvement = Improvement(plan, self.out, workers=self.workers or available_cores(), tell=tell)
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

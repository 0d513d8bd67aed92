"""A policy that gets better in rounds: train, let the expert correct it, train again on everything.

    OUT/improve.json                what decides the result
    OUT/round_00/dataset            the plain demonstrations; from round 1 on also all corrected episodes
    OUT/round_00/train              output folder of lerobot-train, training.log beside it
    OUT/round_00/training.json      the training came to its end: which policy came out
    OUT/round_00/evaluation         the policy on held-out scenes
    OUT/round_01/corrections        the policy of the round before, corrected by the expert

What is there is used again, so that the same command goes on where the last one stopped, whatever stopped it.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from demorec.core.config import GenerateConfig, deciding_versions
from demorec.core.errors import ConfigError, DemorecError, describe_error
from demorec.core.files import LOCK_NAME, free_name, read_json_object, replace_text, run_lock
from demorec.core.own_versions import plain_differences
from demorec.core.plain import to_plain
from demorec.core.processes import start_program
from demorec.core.registry import check_choice
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.features import STATE_KINDS
from demorec.learn.evaluate import Plan, TakeOver
from demorec.learn.evaluate.policy import TRAIN_CONFIG_NAME, find_checkpoint, policy_summary
from demorec.learn.evaluate.rollouts import Evaluation, evaluate, load_evaluation, settings_for
from demorec.learn.evaluate.statistics import Rate
from demorec.learn.evaluate.turns import read_takeover
from demorec.loop.actions import ACTION_KINDS
from demorec.runs.run_file import load_run_file

SETTINGS_NAME, TRAINED_NAME, LOG_NAME = "improve.json", "training.json", "training.log"


@dataclass(frozen=True, kw_only=True)
class Round:
    """A round that is done.

    Attributes:
        number: From 0, the training on plain demonstrations alone.
        demonstrations: Plain ones that were learned from.
        corrections: Corrected episodes that were learned from.
        rate: Of the policy on the held-out scenes.
        cpu_seconds: Of the training; of its last part, where it was interrupted.
    """

    number: int
    demonstrations: int
    corrections: int
    rate: Rate
    cpu_seconds: float


class Improvement:
    """Rounds in one folder.

    Args:
        plan: What to do.
        out: Where.
        demonstrations: A run of plain demonstrations.
        words: Further flags of lerobot-train.
        workers: Processes that simulate.
        tell: Is given a line at every step.

    Raises:
        ConfigError: There is no such run, or no such kind of action or state.
    """

    def __init__(
        self,
        plan: Plan,
        out: Path,
        *,
        demonstrations: Path,
        words: Sequence[str],
        workers: int,
        tell: Callable[[str], None],
    ) -> None:
        self._plan, self._out, self._workers, self._tell = plan, out, workers, tell
        self._demonstrations, self._words = demonstrations, words
        self._action = check_choice("action", plan.action, ACTION_KINDS)
        self._state = check_choice("state", plan.state, STATE_KINDS)
        run = load_run_file(demonstrations)
        self._config = replace(run.config, sampling="random")
        self._num_demonstrations = len(run.successes)

    def rounds(self) -> Iterator[Round]:
        """Do what is missing, and give each round once it is done.

        Raises:
            ConfigError: Another improvement, or something else, is in the folder; or what it needs is missing.
            DemorecError: A training or a rollout failed.
        """
        self._out.mkdir(parents=True, exist_ok=True)
        with run_lock(self._out):
            self._settle()
            for number in range(self._plan.num_rounds + 1):
                yield self._round(number)

    def policy(self, number: int) -> Path:
        """Output folder of a round's training."""
        return self._folder(number) / "train"

    def _settle(self) -> None:
        """Write down what decides, or compare it with what is written there.

        How many rounds and held-out scenes there are may change.
        """
        path = self._out / SETTINGS_NAME
        plan = replace(self._plan, num_rounds=0, num_scenes=0)
        try:
            settings = read_json_object(self._plan.config_path)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"The settings of the training cannot be read ({describe_error(error)}): {self._plan.config_path}"
            ) from error
        # What config_path holds counts, not where it lies.
        names = [field.name for field in fields(Plan) if field.name != "config_path"]
        found = {"words": list(self._words), **{name: to_plain(getattr(plan, name)) for name in names}}
        found |= {"training": settings, "versions": deciding_versions(self._config), "config": to_plain(self._config)}
        if not path.exists():
            if strangers := [each.name for each in self._out.iterdir() if each.name != LOCK_NAME]:
                raise ConfigError(
                    f"The folder holds something else ({strangers[0]}), choose another --out: {self._out}"
                )
            replace_text(path, json.dumps(found, indent=1))
            return
        try:
            before = {"state": "joint", **read_json_object(path)}  # there was no other kind at first
        except (OSError, ValueError, TypeError) as error:
            raise DemorecError(f"{SETTINGS_NAME} is damaged ({describe_error(error)}): {path}") from error
        if lines := plain_differences(before, json.loads(json.dumps(found))):
            raise ConfigError(
                f"Another improvement is in this folder ({'; '.join(lines)}): choose another --out: {self._out}"
            )

    def _round(self, number: int) -> Round:
        folder = self._folder(number)
        folder.mkdir(exist_ok=True)
        if number > 0:
            self._tell(f"round {number}: the expert corrects the policy of round {number - 1}")
            before, plan = self.policy(number - 1), self._plan
            new = replace(self._config, seed=self._config.seed + plan.seed + number)  # scenes that no round had
            self._act(before, new, self._corrections(number), plan.num_episodes, plan.takeover)
        dataset = self._dataset(number)
        self._tell(f"round {number}: training, its output is in {folder / LOG_NAME}")
        seconds = self._train(number, dataset)
        self._tell(f"round {number}: {self._plan.num_scenes} held-out scenes")
        config = replace(self._config, split="eval", seed=0)
        tried = self._act(self.policy(number), config, folder / "evaluation", self._plan.num_scenes)
        return Round(
            number=number,
            demonstrations=self._num_demonstrations,
            corrections=sum(len(corrected_episodes(self._corrections(k))) for k in range(1, number + 1)),
            rate=tried.rate,
            cpu_seconds=seconds,
        )

    def _folder(self, number: int) -> Path:
        return self._out / f"round_{number:02d}"

    def _act(
        self, policy: Path, config: GenerateConfig, out: Path, count: int, takeover: TakeOver | None = None
    ) -> Evaluation:
        own = tuple(name for name in config.cameras if ":" in name)  # the others are named by the policy itself
        settings = settings_for(policy, replace(config, cameras=own), action=self._action)
        return evaluate(replace(settings, takeover=takeover), out, num_episodes=count, workers=self._workers)

    def _corrections(self, number: int) -> Path:
        return self._folder(number) / "corrections"

    def _dataset(self, number: int) -> Path:
        """All that a round learns from."""
        dataset = self._folder(number) / "dataset"
        if dataset.exists():
            return dataset
        part = dataset.with_name("dataset.part")
        options = ExportOptions(
            repo_id="local/improve",
            action=self._action,
            state=self._state,
            privileged=self._plan.privileged,
            features=(*self._plan.features, "intervention") if self._plan.features else (),
            intervention=True,
            verify=False,
        )
        export_lerobot((self._demonstrations,), part, replace(options, overwrite=True))
        for k in range(1, number + 1):
            if corrected_episodes(self._corrections(k)):
                more = replace(options, append=True, corrected_only=True)
                export_lerobot((self._corrections(k),), part, more)
        part.replace(dataset)
        return dataset

    def _train(self, number: int, dataset: Path) -> float:
        """Train unless that is done; CPU seconds."""
        folder = self._folder(number)
        done, train = folder / TRAINED_NAME, self.policy(number)
        if done.exists():
            try:
                found = read_json_object(done)
                seconds = float(found["cpu_seconds"])
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise DemorecError(f"{TRAINED_NAME} is damaged ({describe_error(error)}): {done}") from error
            _, digest = policy_summary(find_checkpoint(train))
            if found.get("policy_digest") != digest:
                raise DemorecError(f"The policy is not the one that was trained here (its digest differs): {train}")
            return seconds
        checkpoint = train / "checkpoints" / "last" / "pretrained_model" / TRAIN_CONFIG_NAME
        if checkpoint.exists():
            words = [f"--config_path={checkpoint}", "--resume=true"]
        else:
            if train.exists():  # no checkpoint yet, and lerobot-train begins in no folder that is there
                train.rename(free_name(folder / "train.unfinished"))
            words = [
                f"--config_path={self._plan.config_path}",
                f"--dataset.root={dataset}",
                "--dataset.repo_id=local/improve",
                f"--output_dir={train}",
                f"--seed={self._plan.seed}",
                *self._words,
            ]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        _run_training(words, folder / LOG_NAME)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        _, digest = policy_summary(find_checkpoint(train))
        replace_text(done, json.dumps({"policy_digest": digest, "cpu_seconds": round(seconds, 1)}, indent=1))
        return seconds


def corrected_episodes(corrections: Path) -> list[int]:
    """Episodes of a folder of corrections that are learned from: the expert took over and succeeded.

    Raises:
        RecordingError: One cannot be read.
    """
    rollouts = load_evaluation(corrections).rollouts
    found = ((r.episode_index, read_takeover(corrections / r.file)) for r in rollouts if r.success)
    return [index for index, taken in found if taken is not None and taken.has_interventions]


def _run_training(words: Sequence[str], log: Path) -> None:
    """demorec train in a process of its own, which ends with this one.

    Raises:
        DemorecError: It failed.
    """
    command = [sys.executable, "-m", "demorec", "train", "--expert-only", *words]
    with log.open("ab") as file:
        process = start_program(command, stdout=file, stderr=subprocess.STDOUT)
        try:
            code = process.wait()
        except BaseException:
            process.terminate()
            process.wait()
            raise
    if code:
        lines = log.read_text(errors="replace").strip().splitlines() or ["no output"]
        raise DemorecError(f"The training failed ({lines[-1].strip()}), its output is in {log}")

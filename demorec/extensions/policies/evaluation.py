"""An evaluation, and its folder: opened under a lock, kept up to date, never mixed with another evaluation."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from demorec.core.config import GenerateConfig, deciding_versions
from demorec.core.errors import ConfigError, DemorecError, GenerationError, describe_error, resource_error, write_error
from demorec.core.files import LOCK_NAME, make_folder, read_json_object, replace_text, run_lock
from demorec.core.own_versions import version_differences
from demorec.core.plain import from_plain, plain_differences, to_plain
from demorec.core.replacing import ReplaceableKind, check_replaceable, delete_parts, json_object, obstacle
from demorec.episode.features import ActionKind, StateKind
from demorec.extensions.policies.statistics import Rate
from demorec.extensions.policies.takeover import TakeOver
from demorec.generate.contents import foreign_recordings
from demorec.runs.find import EVALUATION_NAME
from demorec.runs.run_file import EPISODES, FAILED, Attempt

_PARTS = (EPISODES, FAILED, EVALUATION_NAME)
"""Names that an evaluation writes, and the file that marks it; other files in its folder are never touched."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings that decide the result of an evaluation.

    Attributes:
        policy: Folder of the policy; its path does not affect the result, only `policy_digest` does.
        policy_type: LeRobot's policy type ("act").
        policy_digest: SHA-256 of its config and weights, 16 hex digits.
        config: Task, split, root seed and cameras: the scenes and their views.
        action: Meaning of the policy's actions.
        action_steps: Actions executed before the next observation; None: as trained.
        privileged: Whether it sees observation.environment_state.
        sensed: Other observed features, which datasets have only when named.
        state: Content of its observation.state.
        episode_length: Time limit; None: the environment's.
        takeover: When the expert takes over from the policy; None: never, for an evaluation of the policy alone.
    """

    policy: str
    policy_type: str
    policy_digest: str
    config: GenerateConfig
    action: ActionKind
    action_steps: int | None = None
    privileged: bool = False
    sensed: tuple[str, ...] = ()
    state: StateKind = "joint"
    episode_length: int | None = None
    takeover: TakeOver | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """An evaluation, finished or not.

    Attributes:
        settings: Settings that decide the result.
        rollouts: One line per rollout, in episode order.
        versions: package -> version, of the packages that decide scenes, rollouts and the policy's actions.
    """

    settings: Settings
    rollouts: tuple[Attempt, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def rate(self) -> Rate:
        """Rate of strict successes."""
        return Rate(successes=sum(bool(r.success) for r in self.rollouts), trials=len(self.rollouts))


def load_evaluation(folder: Path) -> Evaluation:
    """Read evaluation.json. Raises ConfigError if it is missing, DemorecError if it is damaged."""
    path = folder / EVALUATION_NAME
    try:
        return from_plain(read_json_object(path), Evaluation)
    except FileNotFoundError as error:
        raise ConfigError(f"No {EVALUATION_NAME}, so this is not an output of demorec evaluate: {folder}") from error
    except (OSError, ValueError) as error:
        raise DemorecError(f"{EVALUATION_NAME} is damaged ({describe_error(error)}): {path}") from error


@contextmanager
def open_evaluation(settings: Settings, out: Path, *, overwrite: bool) -> Iterator[Evaluation]:
    """Yield the existing evaluation, or a new one; the folder is locked until the context ends."""
    _check_place(out, overwrite=overwrite)  # leaves no lock in a refused folder
    make_folder(out)
    with run_lock(out):
        _check_place(out, overwrite=overwrite)
        if overwrite:
            delete_parts(out, _PARTS)
        yield _begin_or_continue(settings, out)


def _check_place(out: Path, *, overwrite: bool) -> None:
    """Raise ConfigError for a folder with content other than an evaluation, or one that was killed as it began."""
    begun = {LOCK_NAME, f"{EVALUATION_NAME}.part"}
    is_free = not out.exists() or (out.is_dir() and {path.name for path in out.iterdir()} <= begun)
    if not is_free and not (out / EVALUATION_NAME).is_file():
        raise ConfigError(f"The folder holds files that are not part of an evaluation, choose another --out: {out}")
    if overwrite and not is_free:
        check_replaceable(out, EVALUATION, overwrite=True)


def _begin_or_continue(settings: Settings, out: Path) -> Evaluation:
    """Create the folder and update its evaluation.json."""
    versions = _versions(settings.config)
    evaluation = Evaluation(settings=settings, versions=versions)
    if (out / EVALUATION_NAME).is_file():
        evaluation = load_evaluation(out)
        there, here = _deciding(evaluation.settings), _deciding(settings)
        if lines := plain_differences(there, here) + version_differences(evaluation.versions, versions):
            advice = "choose another --out" + ("" if obstacle(out, EVALUATION) else " or --overwrite")
            raise ConfigError(f"Another evaluation is in this folder ({'; '.join(lines)}): {advice}: {out}")
        kept = [r for r in evaluation.rollouts if (out / r.file).is_file()]
        evaluation = with_rollouts(replace(evaluation, settings=settings), kept)
    save_evaluation(evaluation, out)  # first, since it makes the folder an evaluation
    for place in (EPISODES, FAILED):
        make_folder(out / place)
    return evaluation


def _is_evaluation(folder: Path) -> bool:
    found = json_object(folder / EVALUATION_NAME)
    return isinstance(found.get("settings"), dict) and isinstance(found.get("rollouts"), list)


EVALUATION = ReplaceableKind(
    name="an evaluation",
    is_folder=True,
    recognises=_is_evaluation,
    strangers=lambda folder: [name for place in (EPISODES, FAILED) for name in foreign_recordings(folder, place)],
)


def _deciding(settings: Settings) -> dict[str, Any]:
    return {key: value for key, value in to_plain(settings).items() if key != "policy"}


def _versions(config: GenerateConfig) -> dict[str, str]:
    """Return the versions of the packages that decide the scenes and run the policy."""
    versions = deciding_versions(config)
    for package in ("lerobot", "torch"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def with_rollouts(evaluation: Evaluation, rollouts: list[Attempt]) -> Evaluation:
    """Return the evaluation with these rollouts, in order."""
    return replace(evaluation, rollouts=tuple(sorted(rollouts, key=lambda r: r.episode_index)))


def save_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Replace evaluation.json atomically. Raises GenerationError or ConfigError if it cannot be written."""
    try:
        replace_text(folder / EVALUATION_NAME, json.dumps(to_plain(evaluation), indent=1, allow_nan=False))
    except OSError as error:
        raise resource_error(error) or write_error("The evaluation", error, folder, GenerationError) from error

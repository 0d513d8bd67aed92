"""What is to be done: which attempts a run still needs, and how two runs differ."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from demorec.core.config import EpisodePlan
from demorec.core.own_versions import version_differences
from demorec.runs.run_file import Attempt, RunFile


class Schedule:
    """Which attempts are due, in which order; nothing else decides them than the run's config and what is known.

    An episode's attempts follow each other (attempt n + 1 when n failed), episodes do not wait for each other.

    Args:
        run: What is known.
        episodes: Order in which episodes are begun; the result does not depend on it.
    """

    def __init__(self, run: RunFile, *, episodes: Iterable[int] | None = None) -> None:
        self._run = run
        self._known = {(a.episode_index, a.attempt): a.success for a in run.attempts}
        self._success = {a.episode_index: a.attempt for a in run.successes}
        self._episodes = iter(range(run.num_episodes) if episodes is None else episodes)
        self._waiting: deque[EpisodePlan] = deque()

    def take(self) -> EpisodePlan | None:
        """The next attempt, or None when none is due now (one may be after another has failed)."""
        while not self._waiting:
            index = next(self._episodes, None)
            if index is None:
                return None
            self._waiting.extend(self._due(index))
        return self._waiting.popleft()

    def give_back(self, plan: EpisodePlan) -> None:
        """This attempt was not carried out: it comes next."""
        self._waiting.appendleft(plan)

    def report(self, attempt: Attempt) -> None:
        """An attempt has ended; after a failure the next one is due, up to the bound."""
        index = attempt.episode_index
        self._known[index, attempt.attempt] = attempt.success
        if not attempt.success and index not in self._success:
            self._waiting.extend(self._due(index))

    def _due(self, index: int) -> Iterator[EpisodePlan]:
        """Attempts that must be made now: the first unknown one, or those missing before a known success."""
        success = self._success.get(index)
        config, versions = self._run.config, self._run.versions
        for number in range(config.max_attempts if success is None else success):
            if (index, number) not in self._known:
                yield EpisodePlan(config=config, episode_index=index, attempt=number, versions=versions)
                if success is None:
                    return


def differences(
    there: Mapping[str, Any],
    there_versions: Mapping[str, str],
    here: Mapping[str, Any],
    here_versions: Mapping[str, str],
) -> tuple[str, ...]:
    """One line for each value in which two configs, as plain data, and their versions differ."""
    return (*plain_differences(there, here), *version_differences(there_versions, here_versions))


def plain_differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[str, ...]:
    """The same for plain data."""
    old, new = _flat(there), _flat(here)
    return tuple(
        f"{key} is {_said(old, key)} there and {_said(new, key)} here"
        for key in dict.fromkeys((*old, *new))
        if _said(old, key) != _said(new, key)
    )


def _flat(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key} "))
        else:
            flat[prefix + key] = value
    return flat


def _said(values: Mapping[str, Any], key: str) -> str:
    if key not in values:
        return "nothing"
    value = values[key]
    if isinstance(value, list | tuple):
        return " ".join(str(item) for item in value) or "none"
    return str(value)

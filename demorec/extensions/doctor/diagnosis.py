"""The diagnosis of a set of episodes: findings, verdict and score of each episode, and unmeasured checks."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from demorec.check.base import FAMILIES, RANK, Check, CheckResult, Finding, Verdict
from demorec.episode.roles import Role
from demorec.extensions.doctor.checks import all_checks
from demorec.extensions.doctor.evidence import Evidence
from demorec.extensions.doctor.scores import score_episodes


@dataclass(frozen=True, kw_only=True)
class EpisodeVerdict:
    """The verdict on one episode.

    Attributes:
        episode: Its number.
        verdict: Worst severity of its findings.
        score: 1 if nothing is unusual; 0 if it is broken.
        reasons: Sentences, worst first.
    """

    episode: int
    verdict: Verdict
    score: float
    reasons: tuple[str, ...]

    @property
    def rank(self) -> tuple[int, float, int]:
        """Sort key, worst first."""
        return -RANK[self.verdict], self.score, self.episode


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Result of the doctor.

    Attributes:
        path: Path of the set.
        taken: Column -> its role.
        findings: Findings, worst first.
        episodes: Verdicts, worst first.
        not_measured: Check -> reason why it could not run.
        num_checks: Number of checks made.
        num_frames: Number of frames read.
        cameras: Names of the cameras with decoded images.
    """

    path: Path
    taken: Mapping[str, Role | None]
    findings: tuple[Finding, ...]
    episodes: tuple[EpisodeVerdict, ...]
    not_measured: Mapping[str, str]
    num_checks: int = 0
    num_frames: int = 0
    cameras: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Worst severity of the findings."""
        return max((finding.severity for finding in self.findings), key=RANK.__getitem__, default="good")

    def to_json(self) -> dict[str, Any]:
        """Convert to JSON data as described in docs/checks.md."""
        fields = ("check", "severity", "episode", "frames", "value", "message", "why", "do")
        episodes = [{**vars(each), "score": round(each.score, 4)} for each in self.episodes]
        return {
            "path": str(self.path),
            "verdict": self.verdict,
            "taken": dict(self.taken),
            "findings": [{name: getattr(finding, name) for name in fields} for finding in self.findings],
            "episodes": episodes,
            "not_measured": [{"check": name, "reason": reason} for name, reason in self.not_measured.items()],
        }


def diagnose(evidence: Evidence, checks: Sequence[Check] | None = None, extra: Sequence[Finding] = ()) -> Diagnosis:
    """Run all checks, or some.

    Args:
        evidence: The set.
        checks: Checks to run; all by default.
        extra: Other findings about the same set, such as those of its files' integrity.

    Raises:
        ResourceError: This machine cannot run one of them.
    """
    results = [check.run(evidence) for check in (all_checks() if checks is None else checks)]
    made = [_unrepeated(result, evidence) for result in results if result is not None]
    findings = [*extra, *(_for_recordings(found, evidence) for result in made for found in result.findings)]
    order = {check.name: FAMILIES.index(check.family) for check in all_checks()}
    findings.sort(
        key=lambda f: (-RANK[f.severity], order.get(f.check, 0), f.check, -1 if f.episode is None else f.episode)
    )
    return Diagnosis(
        path=evidence.path,
        taken=evidence.roles.of,
        findings=tuple(findings),
        episodes=_verdicts(evidence, findings),
        not_measured={result.check: result.not_measured for result in made if result.not_measured},
        num_checks=sum(not result.not_measured for result in made),
        num_frames=sum(episode.length for episode in evidence.episodes),
        cameras=tuple(evidence.cameras),
    )


def _unrepeated(result: CheckResult, evidence: Evidence) -> CheckResult:
    """Turn the reason of unreadable episodes, met by another check, into its reason for not measuring."""
    known = [f for f in result.findings if f.episode is None and f.message in evidence.unreadable.values()]
    if not known:
        return result
    others = tuple(finding for finding in result.findings if finding not in known)
    return replace(result, findings=others, not_measured=known[0].message)


def _for_recordings(finding: Finding, evidence: Evidence) -> Finding:
    """Replace advice to edit the dataset if the evidence is from recordings."""
    if evidence.folder is not None or "demorec dataset" not in finding.do:
        return finding
    name = "the recordings" if finding.episode is None else evidence.names.get(finding.episode, "the recordings")
    view = f"demorec view {shlex.quote(str(evidence.path))}"
    return replace(finding, do=f"look at it: {view}; then leave {name} out, or record it again")


def _verdicts(evidence: Evidence, findings: Sequence[Finding]) -> tuple[EpisodeVerdict, ...]:
    """Build the verdict on each episode, worst first."""
    found = []
    for number, score in evidence.once(score_episodes).items():
        own = [finding for finding in findings if finding.episode == number]
        verdict: Verdict = max((finding.severity for finding in own), key=RANK.__getitem__, default="good")
        reasons = [finding.message for finding in own] + [reason.text for reason in score.reasons]
        found.append(
            EpisodeVerdict(
                episode=number,
                verdict=verdict,
                score=0.0 if verdict == "broken" else score.score,
                reasons=tuple(dict.fromkeys(reasons)),
            )
        )
    return tuple(sorted(found, key=lambda each: each.rank))

"""`demorec replay`: send recorded commands to the simulator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.flags import Allow, Positional, allowed_modules
from demorec.cli.shared.output import ProgressBar, say, tell
from demorec.cli.shared.paths import need_paths
from demorec.core.errors import ConfigError
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings

if TYPE_CHECKING:
    from demorec.extensions.remake.drive import ReplayReport
    from demorec.mcap import Recording


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Send recorded commands to the simulator and compare all sensor data and the outcome with the recording.

    Recordings must replay bit-exactly (on the same type of machine); demorec check --deep also compares labels, phases
    and images. Exit code 0: bit-exact; 1: not.

    Examples:
      demorec replay recordings/cubes/episodes/episode_000000.mcap
      demorec replay recordings/cubes --episodes 0:10
    """

    paths: Positional[tuple[Path, ...]]
    """Recordings, runs, or folders of recordings."""
    episodes: str = ""
    """Episodes to replay, by number: 0:100, ::2, 3,5,8:10; all by default."""
    allow: Allow = ()
    """Module or package of your own that may be imported for the tasks, robots and cameras that the files name."""

    def run(self) -> int:
        """Replay and report."""
        need_paths(self.paths, "replay")
        from demorec.extensions.remake.drive import replay_all

        allowed = allowed_modules(self.allow)
        reports: list[ReplayReport] = []
        with ProgressBar("replaying") as bar:
            for report in replay_all(self._recordings(allowed), allowed):
                reports.append(report)
                bar.advance()
                say(_describe(report))
        if not reports:
            raise ConfigError(f"No episode has a number within {self.episodes!r}.")
        good = sum(report.is_identical and report.is_outcome_as_recorded for report in reports)
        say(_summary(reports, good))
        return 0 if good == len(reports) else 1

    def _recordings(self, allowed: Sequence[str]) -> Iterator[Recording]:
        """Yield the open recordings, in order.

        Before each, prints the versions in which its recorder differs from this installation, and the user's modules
        that have changed.
        """
        from demorec.core.config import deciding_versions
        from demorec.core.own_versions import changed_sources, version_differences
        from demorec.datasets.options import parse_episodes
        from demorec.mcap import open_simulated

        wanted, here = parse_episodes(self.episodes), deciding_versions()
        noted: set[str] = set()
        for path in self.paths:
            found = expect(path, "recording", *EPISODE_FOLDERS)
            expect_recordings(found, found.recordings)
            for file in found.recordings:
                with open_simulated(file) as recording:
                    if not wanted(recording.info.episode_index):
                        continue
                    versions = recording.info.versions
                    lines = [f"{line} since this was recorded" for line in changed_sources(versions, allowed)]
                    lines += version_differences({name: versions[name] for name in versions if name in here}, here)
                    if new := [line for line in lines if line not in noted]:
                        tell(f"Note: {'; '.join(new)}.")
                    noted.update(new)
                    yield recording


def _describe(report: ReplayReport) -> str:
    """Describe a replay in one line."""
    how = "identical"
    if report.first_difference is not None:
        step, what = report.first_difference
        how = f"differs from step {step} on ({what}); at most {_largest([report])}"
    outcome = {None: "", True: ", succeeds", False: f", fails ({', '.join(report.failed_checks)})"}[report.success]
    if not report.is_outcome_as_recorded:
        outcome += f" where the recording {'succeeded' if report.recorded_success else 'failed'}"
    return f"{report.name}: {how}{outcome}"


def _summary(reports: Sequence[ReplayReport], good: int) -> str:
    judged = [report for report in reports if report.success is not None]
    parts = [f"{len(reports)} replayed, {sum(r.is_identical for r in reports)} identical, {good} as recorded"]
    if judged:
        parts.append(f"success {sum(bool(r.success) for r in judged)} of {len(judged)}")
    return "; ".join([*parts, f"largest difference {_largest(reports)}"]) + "."


def _largest(reports: Sequence[ReplayReport]) -> str:
    """Largest differences over all replays."""
    joints = max(report.joint_error for report in reports)
    gripper = max(report.gripper_error for report in reports)
    parts = [f"{joints:.2g} rad", f"gripper {gripper * 1e3:.2g} mm"]
    objects = [report.object_error for report in reports if report.object_error is not None]
    if objects:
        parts.append(f"objects {max(objects) * 1e3:.2g} mm")
    return ", ".join(parts)

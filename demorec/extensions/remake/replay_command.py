"""`demorec replay`: send recorded actions to the simulator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.flags import Allow, Positional, allowed_modules
from demorec.cli.shared.output import ProgressBar, say, say_json, tell
from demorec.cli.shared.paths import need_paths, refuse_sources
from demorec.core.errors import ConfigError, OptionError
from demorec.core.replacing import OptionalTarget
from demorec.runs.find import EPISODE_FOLDERS, Found, expect, expect_recordings

if TYPE_CHECKING:
    from demorec.extensions.remake.demonstration import Demonstration
    from demorec.extensions.remake.drive import ReplayReport


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Send recorded actions to the simulator and compare all sensor data and the outcome with the recording.

    Recordings must replay bit-exactly (on the same type of machine); demorec check --deep also compares labels, phases
    and images. Datasets have float32 actions without the executed exploration noise; for them success and deviations
    are reported. Exit code 0: as recorded (bit-exact; for a dataset: the recorded outcome); 1: not as recorded.
    Recordings that the same command has already written to --out stay.

    Examples:
      demorec replay recordings/cubes/episodes/episode_000000.mcap
      demorec replay recordings/cubes --episodes 0:10
      demorec replay datasets/cubes
      demorec replay episode.mcap --out replayed
    """

    paths: Positional[tuple[Path, ...]]
    """Recordings, runs, folders of recordings, or exported datasets."""
    episodes: str = ""
    """Episodes to replay, by number: 0:100, ::2, 3,5,8:10; all by default."""
    tolerance: float = 0.0
    """Largest difference, in m and rad, that still counts as recorded; for another type of machine."""
    out: OptionalTarget = None
    """Folder for recordings of the replays, images included."""
    overwrite: bool = False
    """Replace recordings in the output folder."""
    allow: Allow = ()
    """Module or package of your own that may be imported for the tasks, robots and cameras that the files name."""
    json: bool = False
    """Print JSON: a list with one object per episode."""

    def run(self) -> int:
        """Replay and report."""
        need_paths(self.paths, "replay")
        if self.tolerance < 0:
            raise OptionError("tolerance", f"is {self.tolerance}, allowed are 0 or more.")
        from demorec.extensions.remake.drive import is_as_recorded, replay_all

        allowed = allowed_modules(self.allow)
        if self.out is not None:
            targets = [self.out / file.name for path in self.paths for file in _replayable(path).recordings]
            refuse_sources(self.paths, targets or [self.out], do="replay")
        found = demonstrations(self.paths, allowed, episodes=self.episodes)
        reports: list[ReplayReport] = []
        with ProgressBar("replaying") as bar:
            for report in replay_all(found, allowed, out=self.out, overwrite=self.overwrite):
                reports.append(report)
                bar.advance()
                if not self.json:
                    say(describe_replay(report))
        if not reports:
            raise ConfigError(f"No episode has a number within {self.episodes!r}.")
        good = [is_as_recorded(r, tolerance=self.tolerance) for r in reports]
        if self.json:
            from demorec.core.plain import to_plain

            say_json([to_plain(report) for report in reports])
        else:
            say(_summary(reports, sum(good)))
            if self.out is not None:
                say(f"Recordings of the replays: {self.out}")
        return 0 if all(good) else 1


def demonstrations(paths: Sequence[Path], allowed: Sequence[str], *, episodes: str) -> Iterator[Demonstration]:
    """Yield the demonstrations in some paths, in order.

    Before each, prints the versions in which its recorder differs from this installation, and the user's modules that
    have changed.
    """
    from demorec.core.config import deciding_versions
    from demorec.core.own_versions import changed_sources, version_differences
    from demorec.robots.assets import allow_models

    allow_models(allowed)
    noted: set[str] = set()
    here = deciding_versions()
    for demonstration in _found(paths, episodes=episodes):
        versions = demonstration.info.versions
        lines = [f"{line} since this was recorded" for line in changed_sources(versions, allowed)]
        lines += version_differences({name: versions[name] for name in versions if name in here}, here)
        if new := [line for line in lines if line not in noted]:
            tell(f"Note: {'; '.join(new)}.")
        noted.update(new)
        yield demonstration


def _found(paths: Sequence[Path], *, episodes: str) -> Iterator[Demonstration]:
    from demorec.datasets.options import parse_episodes
    from demorec.extensions.remake.demonstration import dataset_demonstrations, open_file

    wanted = parse_episodes(episodes)
    for path in paths:
        found = _replayable(path)
        if found.kind == "dataset":
            yield from dataset_demonstrations(path, wanted)
            continue
        for file in found.recordings:
            demonstration = open_file(file)
            if wanted(demonstration.info.episode_index):
                yield demonstration


def _replayable(path: Path) -> Found:
    """Identify a path to replay: a dataset, or recordings."""
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind != "dataset":
        expect_recordings(found, found.recordings)
    return found


def describe_replay(report: ReplayReport) -> str:
    """Describe a replay in one line."""
    how = "identical"
    if report.first_difference is not None:
        step, what = report.first_difference
        how = f"differs from step {step} on ({what}); at most {_largest([report])}"
    outcome = {None: "", True: ", succeeds", False: f", fails ({', '.join(report.failed_checks)})"}[report.success]
    if not report.is_outcome_as_recorded:
        outcome += f" where the recording {'succeeded' if report.recorded_success else 'failed'}"
    lost = f", {report.unreachable} poses out of reach" if report.unreachable else ""
    return f"{report.name}: {how}{outcome}{lost}"


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

"""`demorec replay`: send recorded actions to the simulator."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.flags import Allow, Positional, allowed_modules
from demorec.cli.shared.output import ProgressBar, say, say_json, tell
from demorec.cli.shared.paths import MotorFlags, MotorsByFlags, NamedByFlags, RoleFlags, need_paths, refuse_sources
from demorec.core.errors import ConfigError, OptionError
from demorec.core.registry import modules_of
from demorec.core.replacing import OptionalTarget
from demorec.core.tables import load_robot
from demorec.runs.find import EPISODE_FOLDERS, Found, expect, expect_recordings

if TYPE_CHECKING:
    from demorec.extensions.remake.demonstration import Demonstration, ReplayOptions
    from demorec.extensions.remake.drive import ReplayReport


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Send recorded actions to the simulator and compare all sensor data and the outcome with the recording.

    Recordings must replay bit-exactly (on the same type of machine); demorec check --deep also compares labels, phases
    and images. Datasets have float32 actions without the executed exploration noise; for them success and deviations
    are reported. Exit code 0: as recorded (bit-exact; for a dataset: the recorded outcome); 1: not as recorded.
    Recordings that the same command has already written to --out stay.

    With --robot, a simulated arm executes a real arm's actions, from its dataset or imported recordings, on an empty
    table, and the distance from the measured states is reported for each joint. Exit code 1: a distance over
    --tolerance, if given.

    Examples:
      demorec replay recordings/cubes/episodes/episode_000000.mcap
      demorec replay recordings/cubes --episodes 0:10
      demorec replay datasets/cubes
      demorec replay episode.mcap --out replayed --view
      demorec replay --robot so101 --motor-units degrees datasets/desk
    """

    paths: Positional[tuple[Path, ...]]
    """Recordings, runs, folders of recordings, or exported datasets."""
    episodes: str = ""
    """Episodes to replay, by number: 0:100, ::2, 3,5,8:10; all by default."""
    tolerance: float = 0.0
    """Largest difference, in m and rad, that still counts as recorded; for another type of machine."""
    robot: str = ""
    """Simulated arm for a real arm's actions: a name from `demorec list robots`, or my_package.my_module:MY_ARM."""
    motors: MotorsByFlags = field(default_factory=MotorFlags)
    roles: NamedByFlags = field(default_factory=RoleFlags)
    out: OptionalTarget = None
    """Folder for recordings of the replays, images included."""
    view: bool = False
    """Show recording and replay in Rerun."""
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
        from demorec.extensions.remake.demonstration import ReplayOptions
        from demorec.extensions.remake.drive import is_as_recorded, replay_all

        allowed = (*allowed_modules(self.allow), *modules_of([self.robot]))
        options = ReplayOptions(
            allowed=allowed,
            robot=load_robot(self.robot, allowed) if self.robot else None,
            motors=self.motors.named,
            named=self.roles.named,
        )
        if options.robot is not None and (self.out is not None or self.view):
            raise ConfigError("--robot compares numbers without a scene: leave out --out and --view.")
        options.validate()
        with ExitStack() as stack:
            out = self.out
            if out is None and self.view:
                out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="demorec-replay-")))
            if out is not None:
                targets = [out / file.name for path in self.paths for file in _replayable(path).recordings]
                refuse_sources(self.paths, targets or [out], do="replay")
            found = demonstrations(self.paths, options, episodes=self.episodes)
            reports: list[ReplayReport] = []
            pairs: list[tuple[Path, Path]] = []
            with ProgressBar("replaying") as bar:
                for report, written in replay_all(found, options, out=out, overwrite=self.overwrite):
                    reports.append(report)
                    bar.advance()
                    if not self.json:
                        say(describe_replay(report))
                    if written is not None:
                        pairs.append(written)
            if not reports:
                raise ConfigError(f"No episode has a number within {self.episodes!r}.")
            good = [is_as_recorded(r, tolerance=self.tolerance) for r in reports]
            if self.json:
                from demorec.core.plain import to_plain

                say_json([to_plain(report) for report in reports])
            else:
                if options.robot is not None:
                    say("The simulated table was empty: a gripper that held an object closes farther here.")
                else:
                    say(_summary(reports, sum(good)))
                    say(_compared(reports))
                if self.out is not None:
                    say(f"Recordings of the replays: {self.out}")
            if self.view:
                _show(pairs)
        return 0 if all(good) else 1


def demonstrations(paths: Sequence[Path], options: ReplayOptions, *, episodes: str) -> Iterator[Demonstration]:
    """Yield the demonstrations in some paths, in order.

    Before each, prints the versions in which its recorder differs from this installation, and the user's modules that
    have changed.
    """
    from demorec.core.config import deciding_versions
    from demorec.core.own_versions import changed_sources, version_differences
    from demorec.robots.assets import allow_models

    allow_models(options.allowed)
    noted: set[str] = set()
    here = deciding_versions()
    for demonstration in _found(paths, options, episodes=episodes):
        versions = demonstration.info.versions
        lines = [f"{line} since this was recorded" for line in changed_sources(versions, options.allowed)]
        lines += version_differences({name: versions[name] for name in versions if name in here}, here)
        if new := [line for line in lines if line not in noted]:
            tell(f"Note: {'; '.join(new)}.")
        noted.update(new)
        yield demonstration


def _found(paths: Sequence[Path], options: ReplayOptions, *, episodes: str) -> Iterator[Demonstration]:
    from demorec.datasets.options import parse_episodes
    from demorec.extensions.remake.demonstration import dataset_demonstrations, open_dataset, open_file

    robot, wanted = options.robot, parse_episodes(episodes)
    if robot is not None:
        from demorec.extensions.remake.real_arm import open_real_arm, real_arms  # loads pyarrow
    for path in paths:
        found = _replayable(path)
        if found.kind == "dataset":
            dataset = open_dataset(path, wanted, options)
            yield from dataset_demonstrations(dataset, wanted) if robot is None else real_arms(dataset, robot, wanted)
            continue
        for file in found.recordings:
            demonstration = open_file(file) if robot is None else open_real_arm(file, robot, options)
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
    if report.tracking:
        return f"{report.name}: {report.num_steps} steps; {_tracked(report.tracking)}"
    if report.is_identical:
        how = "identical"
    else:
        assert report.first_difference is not None
        step, what = report.first_difference
        how = (
            f"differs from step {step} on ({what}); at most {report.joint_error:.2g} rad at step "
            f"{report.joint_error_step}, gripper {report.gripper_error * 1e3:.2g} mm"
        )
        if report.object_error_name:
            how += f", {report.object_error_name} {report.object_error * 1e3:.3g} mm at step {report.object_error_step}"
    outcome = {None: "", True: ", succeeds", False: f", fails ({', '.join(report.failed_checks)})"}[report.success]
    if not report.is_outcome_as_recorded:
        outcome += f" where the recording {'succeeded' if report.recorded_success else 'failed'}"
    lost = f", {report.unreachable} poses out of reach" if report.unreachable else ""
    return f"{report.name}: {how}{outcome}{lost}"


def _tracked(tracking: Mapping[str, tuple[float, float]]) -> str:
    """Median and largest difference of each joint."""
    parts = [
        f"{name} {1e3 * median:.1f}, {1e3 * largest:.1f} mm"
        if name == "gripper"
        else f"{name} {math.degrees(median):.2f}, {math.degrees(largest):.2f}"
        for name, (median, largest) in tracking.items()
    ]
    return f"distance from the measured states, median and largest, degrees: {'; '.join(parts)}"


def _compared(reports: Sequence[ReplayReport]) -> str:
    """List of the compared quantities."""
    from demorec.extensions.remake.demonstration import POSE_OF

    found = dict.fromkeys(name for report in reports for name in report.compared)
    names = [name.removeprefix("the ") for name in found if not name.startswith(POSE_OF)]
    objects = ["poses of objects"] if len(names) < len(found) else []
    return f"Compared: {', '.join(names + objects)}; not labels, phases, images."


def _summary(reports: Sequence[ReplayReport], good: int) -> str:
    from demorec.extensions.remake.demonstration import POSE_OF

    judged = [report for report in reports if report.success is not None]
    parts = [f"{len(reports)} replayed, {sum(r.is_identical for r in reports)} identical, {good} as recorded"]
    if judged:
        parts.append(f"success {sum(bool(r.success) for r in judged)} of {len(judged)}")
    largest = [
        f"{max(report.joint_error for report in reports):.2g} rad",
        f"gripper {max(report.gripper_error for report in reports) * 1e3:.2g} mm",
    ]
    if any(name.startswith(POSE_OF) for report in reports for name in report.compared):
        largest.append(f"objects {max(report.object_error for report in reports) * 1e3:.2g} mm")
    return "; ".join([*parts, f"largest difference {', '.join(largest)}"]) + "."


def _show(pairs: Sequence[tuple[Path, Path]]) -> None:
    from demorec.cli import COMMANDS, run_command

    if not pairs:
        raise ConfigError("Nothing to show: --view needs recordings, because a dataset has no scene to draw.")
    recorded, replayed = pairs[0]
    run_command(COMMANDS.load("view"), [str(recorded), str(replayed)], prog="demorec view")

"""`demorec render`: draw recorded states with other cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from demorec.cli.shared.flags import Allow, Positional, allowed_modules, arg
from demorec.cli.shared.output import ProgressBar, counted, say, tell
from demorec.cli.shared.paths import refuse_sources
from demorec.core.errors import ConfigError, check_option
from demorec.core.processes import available_cores, in_turn
from demorec.core.registry import modules_of
from demorec.core.replacing import Target
from demorec.extensions.remake.options import RerenderOptions
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings

if TYPE_CHECKING:
    from demorec.extensions.remake.rerender import RerenderReport
    from demorec.render.painter import WarmRenderer


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render recordings again with other cameras, sizes, renderers or appearance; all numbers stay the same.

    Writes new recordings that name their origin. With the recording's own cameras and appearance, the images are
    bit-exact, which is checked (exit code 1 if they are not). Run the same command again to continue where it stopped.

    Examples:
      demorec render recordings/cubes --out large --width 640 --height 480
      demorec render a.mcap --out corner --cameras front my_cameras:CORNER
      demorec render recordings/cubes --out looks_1 --looks 1 --depth
    """

    paths: Positional[tuple[Path, ...]]
    """Recordings, runs, or folders of recordings."""
    out: Target
    """Folder for the new recordings, or the name of one (.mcap)."""
    options: Annotated[RerenderOptions, arg(name="images")] = field(default_factory=RerenderOptions)
    """Changes of the new images."""
    workers: int | None = None
    """Processes (auto: one per core)."""
    allow: Allow = ()
    """Module or package of your own that may be imported for the tasks, robots and cameras that the files name."""
    overwrite: bool = False
    """Replace recordings that exist already."""

    def run(self) -> int:
        """Render and report."""
        if not self.paths:
            raise ConfigError("No path is given: name a recording or a run, e.g. demorec render recordings --out new.")
        self.options.validate()
        allowed = (*allowed_modules(self.allow), *modules_of(self.options.cameras))
        jobs = _jobs(self.paths, self.out)

        check_option("workers", self.workers, 1, 1024)
        workers = min(self.workers or available_cores(), len(jobs))
        reports: list[RerenderReport] = []
        try:
            with ProgressBar("rendering", total=len(jobs)) as bar:
                for report in in_turn(partial(_draw, self.options, allowed, self.overwrite), jobs, workers):
                    bar.advance()
                    reports.append(report)
                    for camera, frame in report.differing.items():
                        say(f"{report.source.name}: camera {camera} differs from the recording at frame {frame}")
        except KeyboardInterrupt:
            tell(
                f"Interrupted: {len(reports)} of {len(jobs)} recordings are rendered; run the same command again to "
                f"continue: {self.out}"
            )
            return 130
        compared, differing = sum(len(r.compared) for r in reports), sum(len(r.differing) for r in reports)
        if kept := sum(report.was_there for report in reports):
            say(f"{kept} of {len(jobs)} had been rendered before and are unchanged (--overwrite renders them again).")
        say(f"{counted(len(jobs), 'recording')}, {sum(r.num_images for r in reports)} images: {self.out}")
        if compared:
            say(f"{compared - differing} of {compared} unchanged cameras reproduce the recorded images bit-exactly.")
        return 1 if differing else 0


def _jobs(paths: Sequence[Path], out: Path) -> list[tuple[Path, Path]]:
    """(source, new recording) of each job; a run's folders episodes/ and failed/ are kept."""
    jobs: list[tuple[Path, Path]] = []
    for path in paths:
        found = expect(path, "recording", *EPISODE_FOLDERS)
        if found.kind == "recording":
            jobs.append((path, out if out.suffix == ".mcap" else out / path.name))
            continue
        files = (*found.recordings, *found.failed)
        expect_recordings(found, files)
        jobs += [(file, out / file.relative_to(path)) for file in sorted(files)]
    if out.suffix == ".mcap" and len(jobs) > 1:
        raise ConfigError(f"{len(jobs)} recordings cannot become one file: name a folder with --out.")
    refuse_sources(paths, [target for _, target in jobs], do="render")
    return jobs


def _draw(options: RerenderOptions, allowed: Sequence[str], overwrite: bool, job: tuple[Path, Path]) -> RerenderReport:
    from demorec.extensions.remake.rerender import rerender

    return rerender(*job, options, allowed=allowed, overwrite=overwrite, renderers=_renderers())


@cache
def _renderers() -> WarmRenderer:
    """Return the renderer of this process, shared by its recordings."""
    from demorec.render.painter import WarmRenderer

    return WarmRenderer()

"""`demorec report`: show a run or a dataset on one page."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from demorec.cli.shared.flags import Positional, arg
from demorec.cli.shared.output import ProgressBar, counted, say, size_in_words
from demorec.cli.shared.paths import (
    WHAT_IS_READ,
    MappingFile,
    NamedByFlags,
    RoleFlags,
    places_read,
    reading,
    refuse_inside,
)
from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError
from demorec.core.replacing import REPORT, Target
from demorec.runs.find import EPISODE_FOLDERS, expect
from demorec.runs.foreign import imported_kinds

if TYPE_CHECKING:
    from demorec.extensions.doctor.diagnosis import Diagnosis


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Write a self-contained HTML page about a run, recordings or a dataset.

    It shows outcomes, the results of the checks, the distributions of states and actions, and a filmstrip of every
    episode, failed ones first. It needs no network. Exit code 0 means that the page was written, regardless of the
    results; use demorec check for a verdict.

    Examples:
      demorec report recordings/cubes --out cubes.html
      demorec report datasets/cubes --out cubes.html --camera wrist
      demorec report recordings/cubes --out cubes.html --images
    """

    path: Annotated[Positional[Path], arg(help=f"One of: {WHAT_IS_READ}, evaluations.")]
    mapping: MappingFile = None
    out: Target
    """The page (.html)."""
    camera: str = ""
    """Camera for the filmstrips; default: the first one."""
    checks: bool = True
    """Run the checks."""
    images: bool = False
    """Also run the checks that decode all images."""
    overwrite: bool = False
    """Replace an existing report."""
    roles: NamedByFlags = field(default_factory=RoleFlags)

    def run(self) -> int:
        """Gather the content, then write the page."""
        if self.out.suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"--out names an .html file, found the name {self.out.name!r}.")
        if self.images and not self.checks:
            raise ConfigError("--images chooses checks, and --no-checks runs none: leave one of them out.")
        expect(self.path, "recording", "dataset", *imported_kinds(), *EPISODE_FOLDERS)
        if not self.out.absolute().parent.is_dir():
            raise ConfigError(f"--out: folder {self.out.parent} is missing.")
        refuse_inside([self.out])
        from demorec.extensions.report.gather import gather
        from demorec.extensions.report.page import write_page

        with atomic_write(self.out, REPORT, overwrite=self.overwrite, sources=places_read([self.path])) as part:
            with reading([self.path], self.mapping) as (path,), ProgressBar("reading", unit="item") as bar:
                report = gather(
                    path,
                    camera=self.camera,
                    diagnosis=self._diagnosis(path) if self.checks else None,
                    named=self.roles.named,
                    advance=bar.set,
                )
            size = write_page(report, part)
        say(f"{counted(len(report.episodes), 'episode')}, {size_in_words(size)}: {self.out}")
        return 0

    def _diagnosis(self, path: Path) -> Diagnosis:
        """Run the checks of files, numbers and, if requested, images."""
        from demorec.check.report import CheckOptions, check_subjects, find_subjects
        from demorec.extensions.doctor.examine import examine
        from demorec.extensions.doctor.from_dataset import ReadOptions

        options = CheckOptions(images=self.images, colours=False)
        reports = list(check_subjects(find_subjects([path]), options))
        return examine(path, ReadOptions(images=self.images, named=self.roles.named), reports=reports)[0]

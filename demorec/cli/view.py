"""`demorec view`: view episodes in Rerun."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from demorec.cli.shared.flags import Allow, allowed_modules
from demorec.cli.shared.output import say, size_in_words, tell
from demorec.cli.shared.paths import (
    MappingFile,
    NamedByFlags,
    Readable,
    RoleFlags,
    places_read,
    reading,
    refuse_inside,
    tell_incomplete,
    tell_unfinished,
)
from demorec.core.atomic import atomic_write_all
from demorec.core.errors import ConfigError, check_option
from demorec.core.replacing import RERUN_FILE, OptionalTarget
from demorec.core.tables import RANKINGS
from demorec.robots.assets import allow_models

if TYPE_CHECKING:
    from demorec.view.sources import PlaybackSource

_MOST = 50
"""Maximum number of episodes to show unless --episodes asks for more."""
_MOST_REASONS = 10
"""Maximum number of episodes of --rank with printed reasons."""
_RANK_HELP = f"Order of the episodes, the worst first: {', '.join(RANKINGS.names()) or 'none is installed'}."


@dataclass(frozen=True, kw_only=True)
class View:
    """View episodes in Rerun: recordings, runs and exported datasets.

    Opens a window; --save and --web need no screen. Rerun's ffmpeg for H.264 is included; a plain `rerun FILE.rrd`
    plays H.264 only if ffmpeg is on the PATH.

    Examples:
      demorec view recordings/cubes
      demorec view datasets/cubes --episodes 0:10 --web
      demorec view datasets/cubes --rank score
      demorec view recordings/cubes --save cubes.rrd
    """

    paths: Readable
    mapping: MappingFile = None
    episodes: str = ""
    """Episodes to show, counted from 0: 7, or 0:20, or 3,5,8:10; default: the first 50."""
    rank: Annotated[str | None, arg(help=_RANK_HELP)] = None
    include_failures: bool = False
    """Also show the failed attempts of a run."""
    save: OptionalTarget = None
    """Write an .rrd file (layout included) instead of opening a window; several episodes: NAME-0000.rrd and so on."""
    web: bool = False
    """Serve Rerun's web viewer on this machine and print its address; Ctrl-C stops it."""
    port: int | None = None
    """Port of the web viewer (auto: a free one)."""
    allow: Allow = ()
    """A module or package of your own; models of robots and objects next to it may be read."""
    overwrite: bool = False
    """Replace existing files of --save."""
    roles: NamedByFlags = field(default_factory=RoleFlags)

    def run(self) -> int:
        """Convert, then show, save or serve."""
        self._validate()
        allow_models(allowed_modules(self.allow))
        with reading(self.paths, self.mapping) as paths:
            return replace(self, paths=paths)._view()

    def _view(self) -> int:
        from demorec.datasets.options import select_episodes
        from demorec.view.scene import save_each
        from demorec.view.sources import find_episodes
        from demorec.view.viewer import need_screen

        found = find_episodes(self.paths, include_failures=self.include_failures, named=self.roles.named)
        sources = select_episodes(found, self.episodes)
        tell_unfinished(self.paths)
        tell_incomplete(self.paths)
        tell(*dict.fromkeys(note for source in sources for note in source.notes))
        if self.rank is not None:
            sources = self._ranked(sources)
        if self.save is None and not self.web:
            need_screen()  # fail before minutes of conversion
        if len(sources) > _MOST and not self.episodes:
            tell(f"Showing the first {_MOST} of {len(sources)} episodes; --episodes chooses others.")
            sources = sources[:_MOST]
        if self.save is not None:
            self._save(sources, _numbered(self.save, len(sources)))
            return 0
        with tempfile.TemporaryDirectory(prefix="demorec-view-") as folder:
            return self._show(save_each(sources, Path(folder)))

    def _save(self, sources: Sequence[PlaybackSource], targets: Sequence[Path]) -> None:
        """Write all .rrd files; none appears before all are complete."""
        from demorec.view.scene import save

        refuse_inside(targets)
        read = places_read(self.paths)
        with atomic_write_all(targets, RERUN_FILE, overwrite=self.overwrite, sources=read) as parts:
            for source, part in zip(sources, parts, strict=True):
                save(source, part)
        for source, target in zip(sources, targets, strict=True):
            of = f" ({source.name})" if len(targets) > 1 else ""
            say(f"{size_in_words(target.stat().st_size)}: {target}{of}")

    def _ranked(self, sources: Sequence[PlaybackSource]) -> list[PlaybackSource]:
        """Sort the episodes by --rank, and print the reasons for the first ones."""
        assert self.rank is not None
        ranked = RANKINGS.load(self.rank)(self.paths, self.roles.named)
        names = {source.name for source in sources}
        shown = [name for name in ranked if name in names]
        tell(*(ranked[name] for name in shown[:_MOST_REASONS]))
        places = {name: place for place, name in enumerate(shown)}
        return sorted(sources, key=lambda source: places.get(source.name, len(places)))

    def _validate(self) -> None:
        if self.rank is not None:
            RANKINGS.check_name(self.rank)
        check_option("port", self.port, 1, 65535)
        if self.port is not None and not self.web:
            raise ConfigError("--port belongs to --web.")
        if self.save is None:
            return
        if self.web:
            raise ConfigError("--web serves until Ctrl-C: use --save in a separate call.")
        if self.save.suffix != ".rrd":
            raise ConfigError(f"--save writes a .rrd file, found the name {self.save.name!r}.")
        if not self.save.absolute().parent.is_dir():
            raise ConfigError(f"--save: folder {self.save.parent} is missing.")

    def _show(self, files: Sequence[Path]) -> int:
        from demorec.view.viewer import serve_web, show

        if not self.web:
            show(files)
            return 0
        with serve_web(files, web_port=self.port or 0) as (address, wait):
            say(f"Open this in a browser on this machine (Ctrl-C ends it): {address}")
            return 1 if wait() else 0


def _numbered(target: Path, count: int) -> list[Path]:
    """Name `count` files: the target itself for one, NAME-0000.rrd and so on for several.

    Rerun's viewer shows only the last recording of a file, so several episodes are several files.
    """
    if count == 1:
        return [target]
    return [target.with_name(f"{target.stem}-{index:04d}{target.suffix}") for index in range(count)]

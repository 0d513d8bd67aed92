"""import.json: what a run was imported from, by which mapping, and what was found; the reports, kept for `check`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from demorec.core.errors import ConfigError, in_words, resource_error
from demorec.core.files import read_text_limited, replace_text
from demorec.core.plain import from_json, to_json
from demorec.runs.run_file import IMPORT_NAME
from demorec.sources.channel import BagError
from demorec.sources.mapping import BagMapping
from demorec.sources.report import BagReport

FORMAT = 1
_MAX_BYTES = 256 << 20


@dataclass(frozen=True, kw_only=True)
class SkippedBag:
    """A bag that an import left out.

    Attributes:
        name: Of the file or folder, without its place.
        reason: Why, in words.
    """

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImportFile:
    """The content of import.json.

    Attributes:
        format: Of this file.
        mapping: Of all bags.
        mapping_digest: Of it.
        bags: What was read, in order; those that are not whole yet are missing.
        skipped: What was left out, when it was last given.
    """

    format: int = FORMAT
    mapping: BagMapping
    mapping_digest: str
    bags: tuple[BagReport, ...] = ()
    skipped: tuple[SkippedBag, ...] = ()

    @property
    def num_episodes(self) -> int:
        """That were made; the next one has this number."""
        return sum(episode.episode_index is not None for bag in self.bags for episode in bag.episodes)


def load_import_file(folder: Path) -> ImportFile | None:
    """That of a run; None when there is none, BagError when it cannot be read."""
    path = folder / IMPORT_NAME
    try:
        found = from_json(read_text_limited(path, _MAX_BYTES), ImportFile)
        if found.format != FORMAT:
            raise ConfigError(f"import.json has format {found.format}, this demorec knows up to {FORMAT}: {path}")
        return found
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be read ({error.strerror}): {path}"
        ) from error
    except ValueError as error:
        raise BagError(f"import.json is damaged ({in_words(error)}): {path}") from error


def save_import_file(content: ImportFile, folder: Path) -> None:
    """Replace import.json in one step; BagError when it cannot be written."""
    path = folder / IMPORT_NAME
    try:
        replace_text(path, to_json(content, indent=2) + "\n")
    except OSError as error:
        raise resource_error(error, path) or BagError(
            f"import.json cannot be written ({error.strerror}): {path}"
        ) from error

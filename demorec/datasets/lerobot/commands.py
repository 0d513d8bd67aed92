"""The commands that make a dataset, as its card tells them."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from demorec.core.config import GenerateConfig, parse_config
from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import SIDECAR_DIR

_NOT_TOLD = ("append", "overwrite", "verify", "workers", "push_to_hub", "public")
"""Options of an export that leave the dataset's content alone."""


def making_commands(root: Path, configs: Mapping[str, Any], options: ExportOptions) -> list[str]:
    """The two commands that generate the run and export it; none where that is not all of the dataset's story.

    That is so when it was made from several runs or by several exports, from replayed or rendered episodes, or by
    another version of demorec whose configuration this one does not understand.

    Args:
        root: The finished dataset.
        configs: Config digest -> configuration of the runs.
        options: Of the export.
    """
    files = sorted((root / SIDECAR_DIR / "episodes").glob("*/*.parquet"))
    rows = [row for file in files for row in read_table(file, ["run_episode_index", "origin"]).to_pylist()]
    if options.append or len(configs) != 1 or any(row["origin"] for row in rows):
        return []
    try:
        config = parse_config(next(iter(configs.values())), GenerateConfig, source="the configuration")
        config.check_names(config.modules)
    except ConfigError:
        return []
    num_episodes = 1 + max(row["run_episode_index"] for row in rows)
    generating = [f"--num-episodes {num_episodes}", *flags(config, GenerateConfig()), "--no-export --out run"]
    exporting = [f"--repo-id {shlex.quote(options.repo_id)}", *flags(options, ExportOptions(repo_id=options.repo_id))]
    return [
        f"generate-dataset {' '.join(generating)}",
        f"demorec export lerobot run --out dataset {' '.join(exporting)}",
    ]


def flags(values: Any, defaults: Any) -> Iterator[str]:
    """The flags that turn one dataclass into another of its kind: `--seed 7`, `--no-antialias`, `--cameras front`."""
    for field in dataclasses.fields(values):
        value, default = getattr(values, field.name), getattr(defaults, field.name)
        name = field.name.replace("_", "-")
        if field.name in _NOT_TOLD or value == default:
            continue
        if dataclasses.is_dataclass(value):
            yield from flags(value, default)
        elif isinstance(value, bool):
            yield f"--{name}" if value else f"--no-{name}"
        elif isinstance(value, tuple):
            words = value or (("none",) if default else ())  # --cameras none, but a bare --language names no kinds
            yield " ".join([f"--{name}", *(shlex.quote(str(word)) for word in words)])
        else:
            yield f"--{name} {'auto' if value is None else shlex.quote(str(value))}"

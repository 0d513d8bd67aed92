"""Formats that can be imported: `readers` rows of the declaration, and words after `demorec import`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from demorec.core.extensions import reader_rows
from demorec.core.plain import listed
from demorec.extensions.imports.mapping import SourceKind
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.runs.foreign import SourceFormat, formats

_MOST_SHOWN = 6
"""Maximum features and cameras of a mapping that are listed."""

BAGS = SourceFormat(
    kind="rosbag",
    example="monday.mcap --mapping robot.toml --out runs/robot",
    importer="demorec.extensions.imports.import_run:import_bags",
    suggester="demorec.extensions.imports.suggest:suggested_mapping",
    reviewer="demorec.extensions.imports.formats:review_mapping",
    describer="demorec.extensions.imports.describe:describe_bags",
    dropped="demorec.extensions.imports.describe:dropped_rows",
)
DATASETS = SourceFormat(
    kind="dataset",
    example="datasets/cups --out runs/cups",
    importer="demorec.extensions.imports.dataset_import:import_lerobot",
)
HDF5 = SourceFormat(
    kind="hdf5",
    example="demo.hdf5 --mapping mapping.toml --out runs/demo",
    importer="demorec.extensions.imports.hdf5_import:import_hdf5",
    suggester="demorec.extensions.imports.hdf5_suggest:suggested_hdf5_mapping",
    reviewer="demorec.extensions.imports.formats:review_hdf5_mapping",
    describer="demorec.extensions.imports.describe:describe_hdf5",
)


def formats_by_word() -> Mapping[str, SourceFormat]:
    """First word after `demorec import` -> its format; bags need none."""
    return {row.word: formats()[kind] for kind, row in reader_rows().items() if row.word}


def review_mapping(path: Path, kind: SourceKind = "bag") -> str:
    """Features and cameras of a mapping, in words; errors as in `read_mapping`."""
    mapping = read_mapping(path, kind)
    parts = [
        f"{name} from {' and '.join(dict.fromkeys(source.place for source in of))}"
        for name, of in mapping.features.items()
    ]
    return listed([*parts, *(f"camera {name}" for name in mapping.cameras)], _MOST_SHOWN, ", ")


review_hdf5_mapping = partial(review_mapping, kind="hdf5")

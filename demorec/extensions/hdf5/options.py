"""Options of an export to HDF5."""

from __future__ import annotations

from dataclasses import dataclass

from demorec.core.errors import OptionError
from demorec.datasets.options import CommonOptions, Exporter


@dataclass(frozen=True, kw_only=True)
class Hdf5Options(CommonOptions):
    """Options of an export to HDF5."""

    valid_share: float = 0.1
    """Share of the episodes that mask/valid names, spread evenly; mask/train names the others."""

    def validate(self) -> None:
        """Raise ConfigError for impossible values."""
        super().validate()
        if not 0 <= self.valid_share < 1:
            raise OptionError("valid_share", f"is {self.valid_share}, allowed are 0 to below 1.")


HDF5 = Exporter(
    summary="robomimic's layout, one HDF5 file: decoded images, the same numbers, masks for training and validation",
    options=Hdf5Options,
    function="demorec.extensions.hdf5.export:export_hdf5",
)

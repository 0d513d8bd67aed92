"""Marks of options, which are fields of dataclasses."""

from typing import Annotated, TypeVar

T = TypeVar("T")
RARE = object()
Rare = Annotated[T, RARE]
"""Type of an option, or of a dataclass of options, that --help leaves out and --help-all shows."""

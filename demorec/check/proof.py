"""Proofs that a recording is what its config and seed give, by the extensions that can make it again."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.core.extensions import rows_of


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Result of a proof of one recording.

    Attributes:
        path: The recording.
        level: "warn" where this machine cannot prove it, "fail" where it is not the same.
        problem: What differs; "" unless it failed.
    """

    path: Path
    level: Literal["pass", "warn", "fail"]
    problem: str = ""


def prove(paths: Sequence[Path], allowed: Sequence[str] = ()) -> Iterator[Proof]:
    """Yield the proofs of recordings; nothing without an extension that has any.

    Args:
        paths: The recordings.
        allowed: Modules of the user that may be imported for what the recordings name.
    """
    for _, target in rows_of("proofs"):
        yield from pkgutil.resolve_name(target)(paths, allowed)

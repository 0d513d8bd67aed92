"""Proofs that a recording follows from its config and seed, by extensions that can remake it."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.core.extension import rows_of


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Result of a proof of one recording.

    Attributes:
        path: The recording.
        level: "warn" if this machine cannot prove it, "fail" if the remake differs.
        problem: The difference; "" unless it failed.
    """

    path: Path
    level: Literal["pass", "warn", "fail"]
    problem: str = ""


def prove(paths: Sequence[Path], allowed: Sequence[str] = ()) -> Iterator[Proof]:
    """Yield the proofs of recordings; none without an extension for it.

    Args:
        paths: The recordings.
        allowed: The user's modules that may be imported if the recordings name them.
    """
    for _, target in rows_of("proofs"):
        yield from pkgutil.resolve_name(target)(paths, allowed)

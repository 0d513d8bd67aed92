"""Object sets: kinds of objects, each with many shapes, a material and named colours."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from demorec.episode.mesh import SolidMesh
from demorec.episode.scene import Pattern

Split = Literal["all", "train", "eval"]
HELD_OUT = 5
"""Period of shape numbers reserved for `eval`: number 4, 9, 14, ..."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """Density, friction and appearance."""

    density: tuple[float, float]  # (low, high) kg/m^3 of the whole solid, including the content of a tin or bottle
    friction: tuple[float, float]  # (low, high) lateral coefficient
    patterns: tuple[Pattern, ...]  # textures, one of which an object gets


MATERIALS: Mapping[str, Material] = {
    "ceramic": Material(density=(1500.0, 2200.0), friction=(0.5, 0.9), patterns=("plain", "stripes", "noise")),
    "glass": Material(density=(2200.0, 2600.0), friction=(0.5, 0.9), patterns=("plain",)),
    "metal": Material(density=(500.0, 1100.0), friction=(0.5, 0.8), patterns=("plain", "stripes", "checker")),
    "plastic": Material(density=(300.0, 900.0), friction=(0.5, 0.9), patterns=("plain", "stripes", "checker")),
    "carton": Material(density=(200.0, 600.0), friction=(0.5, 0.9), patterns=("stripes", "checker", "noise")),
    "fruit": Material(density=(700.0, 1000.0), friction=(0.6, 1.0), patterns=("noise",)),
    "wood": Material(density=(400.0, 800.0), friction=(0.5, 1.0), patterns=("wood",)),
}


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Objects of one name."""

    noun: str  # its word in instructions
    material: str  # row of `MATERIALS`
    # Number 0 .. count - 1 -> that shape, roughly in its resting pose; always the same.
    shape: Callable[[int], SolidMesh]
    count: int
    colors: tuple[str, ...] = ()  # names of its possible colours; empty for all
    yaw_symmetry: int = 1  # as in `Body.yaw_symmetry`

    def numbers(self, split: Split) -> Sequence[int]:
        """Numbers of the shapes of a split; with fewer than `HELD_OUT` shapes none is held out."""
        held_out = range(HELD_OUT - 1, self.count, HELD_OUT)
        return {"all": range(self.count), "eval": held_out}.get(
            split, [n for n in range(self.count) if n not in held_out]
        )


def drawn(
    material: str, *, count: int, colors: tuple[str, ...] = (), yaw_symmetry: int = 1
) -> Callable[[Callable[[np.random.Generator], SolidMesh]], Kind]:
    """Make a kind from a function that draws one shape; the function's name is the noun and seeds the shapes."""

    def kind(draw: Callable[[np.random.Generator], SolidMesh]) -> Kind:
        noun = draw.__name__.strip("_")
        name = zlib.crc32(noun.encode())
        return Kind(
            noun=noun,
            material=material,
            shape=lambda number: draw(np.random.default_rng((name, number))),
            count=count,
            colors=colors,
            yaw_symmetry=yaw_symmetry,
        )

    return kind


@dataclass(frozen=True, kw_only=True)
class Shelf:
    """Set of kinds to draw objects from."""

    kinds: tuple[Kind, ...]

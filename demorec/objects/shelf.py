"""What a shelf is: kinds of things, each in many shapes, of a material, in colours that have a name."""

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
"""Each shape whose number is one less than a multiple of this is kept for `eval`."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """How heavy and how slippery, and what it looks like.

    Attributes:
        density: (low, high) kg/m^3 of the whole solid, what is in a tin or a bottle included.
        friction: (low, high) lateral coefficient.
        patterns: Of its textures, one of which a thing gets.
    """

    density: tuple[float, float]
    friction: tuple[float, float]
    patterns: tuple[Pattern, ...]


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
    """Things of one name.

    Attributes:
        noun: Its word in instructions.
        material: Row of `MATERIALS`.
        shape: Number 0 .. count - 1 -> that shape, about as it is to lie on a table; always the same.
        count: How many different shapes there are.
        colors: Words of the colours that it may have; empty for all.
        yaw_symmetry: As `Body.yaw_symmetry`.
    """

    noun: str
    material: str
    shape: Callable[[int], SolidMesh]
    count: int
    colors: tuple[str, ...] = ()
    yaw_symmetry: int = 1

    def numbers(self, split: Split) -> Sequence[int]:
        """The shapes of a split; with fewer than `HELD_OUT` none is held out."""
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
    """Kinds of things that one draws from."""

    kinds: tuple[Kind, ...]

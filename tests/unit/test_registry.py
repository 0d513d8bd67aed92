"""Names, nearest matches and third-party modules."""

from __future__ import annotations

import pytest

from demorec.core.errors import ConfigError, NotAllowedError
from demorec.core.registry import Registry

SHAPES: Registry[type] = Registry(
    kind="shape",
    rows={"ordered": "collections:OrderedDict", "counter": "collections:Counter"},
    subclass_of="numbers:Number",
)
NUMBERS: Registry[object] = Registry(kind="number", rows={}, instance_of="numbers:Number")


def test_a_name_that_the_module_lacks_gets_the_nearest_match() -> None:
    with pytest.raises(ConfigError, match=r"since the module has no such name\. Did you mean 'Fraction'\?"):
        SHAPES.load("fractions:Fracton", ["fractions"])


@pytest.mark.parametrize("allowed", [(), ("fraction",), ("fractions.sub",), ("decimal",)])
def test_a_third_party_object_needs_an_allowed_module(allowed: tuple[str, ...]) -> None:
    with pytest.raises(NotAllowedError, match=r"if you trust that module, add --allow fractions\."):
        SHAPES.load("fractions:Fraction", allowed)


@pytest.mark.parametrize("name", ["os:abort", "builtins:exit", "demorec.core.errors:DemorecError", "fractions:math"])
def test_objects_of_another_kind_are_refused_and_not_called(name: str) -> None:
    with pytest.raises(ConfigError, match=r"is not a shape: it must be a subclass of numbers\.Number"):
        SHAPES.load(name, [name.partition(":")[0]])


def test_a_class_is_not_an_instance_of_itself() -> None:
    assert NUMBERS.load("math:pi", ["math"]) == pytest.approx(3.14159, abs=1e-5)
    with pytest.raises(ConfigError, match=r"is not a number: it must be an instance of numbers\.Number"):
        NUMBERS.load("fractions:Fraction", ["fractions"])


def test_an_unfinished_class_is_refused() -> None:
    from demorec.core.tables import TASKS

    with pytest.raises(ConfigError, match="is not complete: it lacks evaluate, instruction, sample_scene, script"):
        TASKS.load("demorec.tasks.base:Task", ["demorec"])


@pytest.mark.parametrize(
    "name", ["", ":", "a:", ":b", "a:b:c", "a b:c", "a..b:c", "a:b.c", "../a:b", "no colon", "1:2"]
)
def test_malformed_names_are_unknown_even_if_allowed(name: str) -> None:
    with pytest.raises(ConfigError, match="Unknown shape"):
        SHAPES.load(name, ["a", "no", ""])

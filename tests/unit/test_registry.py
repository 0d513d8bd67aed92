"""Names, nearest matches and somebody else's modules."""

from __future__ import annotations

import pytest

from demorec.errors import ConfigError, MissingDependencyError
from demorec.registry import Registry

SHAPES: Registry[object] = Registry(
    kind="shape", rows={"ordered": "collections:OrderedDict", "counter": "collections:Counter"}, open_to_others=True
)


def test_known_names_load() -> None:
    import collections

    assert SHAPES.load("counter") is collections.Counter


def test_unknown_names_get_the_nearest_match() -> None:
    with pytest.raises(ConfigError, match=r"Unknown shape 'conter'\. Did you mean 'counter'\?"):
        SHAPES.load("conter")


def test_somebody_elses_object_loads() -> None:
    import decimal

    assert SHAPES.load("decimal:Decimal") is decimal.Decimal


@pytest.mark.parametrize("name", ["no_such_package.task:Mine", "decimal:NoSuchThing"])
def test_somebody_elses_mistake_is_one_sentence(name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be imported"):
        SHAPES.load(name)


def test_closed_tables_refuse_foreign_names() -> None:
    closed: Registry[object] = Registry(kind="camera", rows={"front": "collections:Counter"})
    with pytest.raises(ConfigError, match="Unknown camera"):
        closed.load("decimal:Decimal")


def test_errors_cross_processes() -> None:
    import pickle

    error = MissingDependencyError("The Ray executor", "ray", "pip install 'demorec[ray]'")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert "needs the package 'ray'" in str(error)

"""The checks of this folder's modules, and rows `checks` of other extensions."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from demorec.check.base import FAMILIES, Check
from demorec.core.extension import rows_of


@cache
def all_checks() -> tuple[Check, ...]:
    """List all checks by family, in the order of their modules and lines."""
    modules = sorted(module.name for module in pkgutil.iter_modules(__path__))
    loaded = [importlib.import_module(f"{__name__}.{name}") for name in modules]
    found = [value for module in loaded for value in vars(module).values() if isinstance(value, Check)]
    found += [pkgutil.resolve_name(target) for _, target in rows_of("checks")]
    return tuple(sorted(dict.fromkeys(found), key=lambda check: FAMILIES.index(check.family)))

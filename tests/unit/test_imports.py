"""The import rules of pyproject.toml cover every folder, and modules do not import each other in cycles."""

from __future__ import annotations

import tomllib
from copy import deepcopy
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import grimp
import importlinter.application.use_cases as import_linter
import pytest
from importlinter.configuration import configure
from importlinter.domain.contract import registry

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
HOMES = {
    "pybullet": "demorec.sim",
    "pybullet_data": "demorec.sim",
    "mcap": "demorec.mcap",
    "foxglove": "demorec.mcap",
    "rerun": "demorec.view",
    "tyro": "demorec.cli",
    "tqdm": "demorec.cli",
    "h5py": "demorec.extensions.hdf5",
    "rosbags": "demorec.extensions.imports",
    "ruamel": "demorec.extensions.imports",
    "ray": "demorec.generate.on_ray",
}
"""Heavy library -> the folder or module of demorec that alone imports it (CONTRIBUTING.md)."""
NEW_FOLDER = "demorec.made_for_trial"


@cache
def _graph(*, with_type_checking: bool) -> grimp.ImportGraph:
    return grimp.build_graph(
        *("demorec", "lerobot_policy_act_keypoints"),
        include_external_packages=True,
        exclude_type_checking_imports=not with_type_checking,
        cache_dir=None,
    )


def _rules() -> list[dict[str, Any]]:
    rules: list[dict[str, Any]] = tomllib.loads(PROJECT.read_text())["tool"]["importlinter"]["contracts"]
    return rules


def _is_broken(rule: dict[str, Any], *extra: tuple[str, str]) -> bool:
    """Whether import-linter reports a broken rule after adding these (importer, imported) to the existing imports."""
    configure()
    options = import_linter.read_user_options(str(PROJECT))
    import_linter._register_contract_types(options)
    graph = deepcopy(_graph(with_type_checking=False))
    for importer, imported in extra:
        graph.add_import(importer=importer, imported=imported)
    (contract,) = (option for option in options.contracts_options if option["name"] == rule["name"])
    kind = registry.get_contract_class(contract["type"])
    checked = kind(name=rule["name"], session_options=options.session_options, contract_options=contract)
    return not checked.check(graph, verbose=False).kept


def _one_home_rules() -> list[dict[str, Any]]:
    return [rule for rule in _rules() if rule["name"].endswith("one home")]


def _folders() -> list[str]:
    """Every folder and loose module of the package, and one that does not exist yet."""
    return [*sorted(_graph(with_type_checking=False).find_children("demorec")), NEW_FOLDER]


def test_no_modules_import_each_other() -> None:
    """Neither at the top, nor inside functions, nor for the type checker alone."""
    graph = _graph(with_type_checking=True)
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


@pytest.mark.parametrize("library", HOMES)
def test_a_library_is_imported_in_one_place_only(library: str) -> None:
    """A module that is added to any folder, even the first one in a new folder, may not import it."""
    (rule,) = (rule for rule in _one_home_rules() if library in rule["forbidden_modules"])
    assert not _is_broken(rule)
    for folder in _folders():
        importer = f"{folder}.made_for_trial"
        assert _is_broken(rule, (importer, library)) == (folder != HOMES[library]), importer


def test_every_folder_has_its_own_rule() -> None:
    """The author of a new folder must specify the direction of its imports."""
    placed: set[str] = set()
    for rule in _rules():
        placed |= {f"demorec.{layer.strip('()')}" for layer in rule.get("layers", ())}
        placed |= {*rule.get("source_modules", ()), *rule.get("containers", ())}
    assert set(_folders()) - placed == {NEW_FOLDER}

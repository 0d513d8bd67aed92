"""README's "Train now": lerobot-train with the settings of examples/, and plug-in policies in `evaluate`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from support.docs import ROOT

from demorec.core.errors import MissingDependencyError
from demorec.extensions.policies.policy import Policy

pytestmark = pytest.mark.usefixtures("hf_datasets_cache")

CONFIGS = sorted((ROOT / "examples").glob("*.json"))


@pytest.mark.slow
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.stem))
def test_lerobots_parser_takes_the_configs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import draccus
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.policies import factory  # noqa: F401  # which registers the policies' types
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    monkeypatch.setattr(sys, "argv", ["lerobot-train", f"--config_path={path}"])
    config: Any = draccus.parse(TrainPipelineConfig, args=[f"--config_path={path}"])
    config.output_dir = None
    config.validate()
    assert config.policy.type.split("_")[0] == path.stem.split("_")[0]
    assert config.batch_size == json.loads(path.read_text())["batch_size"]
    assert config.policy.push_to_hub is False
    assert config.dataset.video_backend == "pyav"


def test_a_policy_of_an_unknown_type_names_its_package(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text('{"type": "nowhere"}')
    with pytest.raises(MissingDependencyError) as error:
        Policy(tmp_path)
    assert str(error.value).startswith(
        "A policy of type 'nowhere' needs the package 'lerobot_policy_nowhere', which is not installed: "
    )
    assert capfd.readouterr() == ("", "")


def test_a_plugin_that_lacks_a_package_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """An installed plug-in whose own import fails: LeRobot would print its traceback."""
    folder = tmp_path / "installed"
    (folder / "lerobot_policy_nowhere-1.0.dist-info").mkdir(parents=True)
    about = folder / "lerobot_policy_nowhere-1.0.dist-info" / "METADATA"
    about.write_text("Metadata-Version: 2.1\nName: lerobot_policy_nowhere\nVersion: 1.0\n")
    (folder / "lerobot_policy_nowhere.py").write_text("import a_package_that_nobody_has\n")
    monkeypatch.syspath_prepend(folder)
    (tmp_path / "config.json").write_text('{"type": "nowhere"}')
    with pytest.raises(MissingDependencyError, match="needs the package 'a_package_that_nobody_has', which is not"):
        Policy(tmp_path)
    assert capfd.readouterr() == ("", "")

"""The programs and layouts in viewers/ work on a recording."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader
from support.recording import write_episode

VIEWERS = Path(__file__).parents[2] / "viewers"
PROGRAMS = {
    "one_stream.py": (".", "/tracking_error"),
    "all_paths.py": (".", "/paths/episode_000000"),
    "own_layout.py": ("episodes/episode_000000.mcap", "/world/cameras/wrist"),
}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cubes")
    (folder / "episodes").mkdir()
    write_episode(folder / "episodes" / "episode_000000.mcap", num_frames=12)
    return folder


def test_every_program_is_listed_here() -> None:
    assert {file.name for file in (VIEWERS / "rerun").glob("*.py")} == set(PROGRAMS)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_run_and_are_short(name: str, run_folder: Path, tmp_path: Path) -> None:
    source, entity = PROGRAMS[name]
    program, target = VIEWERS / "rerun" / name, tmp_path / "x.rrd"
    assert len(program.read_text().splitlines()) <= 80
    command = [sys.executable, str(program), str(run_folder / source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert entity in {chunk.entity_path for chunk in RrdReader(target).stream()}


@pytest.mark.parametrize("layout", sorted((VIEWERS / "foxglove").glob("*.json")), ids=lambda path: path.stem)
def test_foxglove_layouts_use_topics_of_recordings(layout: Path, run_folder: Path) -> None:
    content = json.loads(layout.read_text())
    panels = content["configById"]
    assert set(_leaves(content["layout"])) == set(panels)
    messages: dict[str, Any] = {}
    with (run_folder / "episodes" / "episode_000000.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, message)
    wanted = sorted(set(re.findall(r'"(/[a-z][^"]*)"', layout.read_text())))
    assert len(wanted) > 20
    for path in wanted:
        topic, _, field = path.partition(".")
        assert topic in messages, path
        if field:
            name, _, index = field.rstrip("]").partition("[")
            value = getattr(messages[topic], name)
            assert not index or int(index) < len(value), path


def _leaves(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        yield from _leaves(node["first"])
        yield from _leaves(node["second"])

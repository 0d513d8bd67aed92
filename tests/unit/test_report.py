"""`demorec report`, read by an independent HTML parser; Pillow reads its images."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.check import edit_parquet
from support.commands import exit_code
from support.export import export, make_run
from support.foreign_dataset import DATA, write_foreign
from support.mcap import rewritten
from support.recording import frame_number, write_episode

from demorec.episode.roles import NO_NAMES, Column, find_roles
from demorec.extensions.report.filmstrip import MAX_SHOWN, MAX_STRIP_BYTES, Filmstrip
from demorec.extensions.report.gather import Components, add_motion, gather
from demorec.extensions.report.page import distribution, page
from demorec.mcap import Recording

HOSTILE = "</p><script>document.title = 'taken'</script><img src=x onerror=alert(1)>\"'&\u202e"
MOST_BYTES = 30_000_000
TEMPLATES = Path(__file__).parents[2] / "demorec" / "extensions" / "report" / "templates"
VOID = ("img", "meta", "input", "br")


@dataclass
class Page(HTMLParser):
    """Content of a page.

    Attributes:
        tags: (name, attributes) of every element.
        articles: Text of every article.
        words: Text outside of style and script.
    """

    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    articles: list[str] = field(default_factory=list)
    words: str = ""
    open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, name: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((name, dict(attributes)))
        if name == "article":
            self.articles.append("")
        if name not in VOID:
            self.open.append(name)

    def handle_endtag(self, name: str) -> None:
        assert self.open.pop() == name, "elements close in the order in which they open"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("style", "script"):
            return
        self.words += data
        if "article" in self.open and data.strip():
            self.articles[-1] += f"{data} "

    def all(self, name: str) -> Iterator[dict[str, str | None]]:
        return (attributes for found, attributes in self.tags if found == name)


def parsed(text: str) -> Page:
    found = Page()
    found.feed(text)
    found.close()
    assert found.open == []
    return found


def report_on(path: Path, *, camera: str = "") -> Page:
    return parsed(page(gather(path, camera=camera)))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes and a failed attempt, without a run.json: a folder of recordings."""
    return make_run(
        tmp_path_factory.mktemp("report") / "cubes", (24, 30, 24), failures=(1,), cameras=("front", "wrist")
    )


@pytest.fixture(scope="module")
def dataset(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "cubes_dataset"
    export(run, out)
    return out


def test_failures_come_first(run: Path) -> None:
    found = report_on(run)
    assert [words.split(" failed")[0].strip() for words in found.articles[:1]] == ["episode 1, attempt 0"]
    assert "distance_to_target in phase place" in found.articles[0]
    assert ["failed" in words for words in found.articles] == [True, False, False, False]
    assert "3 of 4 attempts succeeded: 75.0 %" in found.words


def test_nothing_is_loaded_from_elsewhere(run: Path) -> None:
    text = page(gather(run))
    assert "://" not in text
    found = parsed(text)
    assert {name for name, _ in found.tags} & {"link", "iframe", "object", "base", "form"} == set()
    assert all((image["src"] or "").startswith("data:image/jpeg;base64,") for image in found.all("img"))
    assert not [key for _, attributes in found.tags for key in attributes if key.startswith("on") or key == "style"]


def test_a_filmstrip_shows_the_frames_that_it_names(run: Path) -> None:
    """Each image shows its frame's number as a bar code."""
    found = report_on(run)
    assert len(list(found.all("img"))) == 4
    for image, words in zip(found.all("img"), found.articles, strict=True):
        strip = Image.open(io.BytesIO(base64.b64decode((image["src"] or "").partition(",")[2])))
        assert strip.size == (int(image["width"] or 0), int(image["height"] or 0))
        length = int(re.findall(r"(\d+) frames", words)[0])
        width = strip.width // 8
        for number in range(8):
            part = strip.crop((number * width, 0, (number + 1) * width, strip.height)).resize((64, 48))
            assert frame_number(np.asarray(part)) == round(number * (length - 1) / 7)


def test_the_camera_is_chosen(run: Path, dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for path in (run, dataset):
        for camera in ("front", "wrist"):
            alts = [image["alt"] or "" for image in report_on(path, camera=camera).all("img")]
            assert alts
            assert all(f"camera {camera}," in alt for alt in alts)
        assert exit_code("report", path, "--no-checks", "--camera", "rear", "--out", tmp_path / "r.html") == 2
        assert "available are front, wrist" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_and_its_run_have_the_same_report(run: Path, dataset: Path) -> None:
    ours, theirs = gather(run), gather(dataset)
    of_run = {key: np.concatenate(parts).tolist() for key, parts in gather(run / "episodes").distributions.items()}
    assert {key: np.concatenate(parts).tolist() for key, parts in theirs.distributions.items()} == of_run
    for name in ("name", "success", "instruction", "num_frames"):
        assert [getattr(e, name) for e in theirs.episodes] == [getattr(e, name) for e in ours.episodes[:3]]
    assert not theirs.missing


def test_a_third_party_dataset_lists_missing_parts(dataset: Path, tmp_path: Path) -> None:
    other = shutil.copytree(dataset, tmp_path / "other")
    shutil.rmtree(other / "demorec")
    found = report_on(other)
    assert "3 of 3 attempts succeeded" in found.words  # from the column next.success
    assert len(list(found.all("img"))) == 3
    file = other / "meta" / "info.json"
    plain = json.loads(file.read_text())
    for name in ("next.success", "action"):
        del plain["features"][name]
    for name in ("front", "wrist"):
        del plain["features"][f"observation.images.{name}"]
    file.write_text(json.dumps(plain))
    found = report_on(other)
    assert "No action found, so nothing was judged by it" in found.words
    assert list(found.all("img")) == []
    assert all("outcome unknown" in words for words in found.articles)


def test_images_in_rows_are_shown(tmp_path: Path) -> None:
    """Frame t of episode e has the brightness 10 + 20 t + 40 e."""
    root = write_foreign(tmp_path / "rows")
    files = [io.BytesIO() for _ in range(16)]
    for row, file in enumerate(files):
        Image.new("RGB", (64, 48), (10 + 20 * (row % 8) + 40 * (row // 8),) * 3).save(file, "PNG")
    images = [{"bytes": file.getvalue(), "path": None} for file in files]
    edit_parquet(root / DATA, "observation.images.top", lambda _: images)
    found = report_on(root)
    strips = [
        Image.open(io.BytesIO(base64.b64decode((image["src"] or "").partition(",")[2]))) for image in found.all("img")
    ]
    assert len(strips) == 2
    for episode, strip in enumerate(strips):
        parts = np.asarray(strip.convert("L")).reshape(strip.height, 8, -1)[:, :, 16:-16].mean(axis=(0, 2))
        assert parts == pytest.approx(10 + 20 * np.arange(8) + 40 * episode, abs=3)


def test_foreign_text_has_no_effect(run: Path, tmp_path: Path) -> None:
    """Text in a recording is escaped: the page has the same elements as without it."""
    good = run / "episodes" / "episode_000000.mcap"
    with Recording(good) as recording:
        episode, outcome = (recording._container.metadata(f"demorec.{name}") for name in ("episode", "outcome"))
    assert episode is not None
    assert outcome is not None
    info, ended = json.loads(episode["info"]), json.loads(outcome["outcome"])
    info["instruction"] = HOSTILE
    ended.update(success=False, failure_phase=HOSTILE, failure_reason=HOSTILE)
    change = {"demorec.episode": {"info": json.dumps(info)}, "demorec.outcome": {"outcome": json.dumps(ended)}}
    folder = tmp_path / "<script>alert(1)<"
    folder.mkdir()
    (folder / "<b>.mcap").write_bytes(rewritten(good, change=change))
    text = page(gather(folder))
    found = parsed(text)
    assert "\u202e" not in text
    assert "script" not in [name for name, _ in found.tags]
    assert not [key for _, attributes in found.tags for key in attributes if key.startswith("on")]
    assert "|safe" not in "".join(file.read_text() for file in TEMPLATES.glob("*.html")).replace(" ", "")
    shown = HOSTILE.replace("\u202e", "\\u202e")
    assert found.articles[0].count(shown) >= 3


@pytest.mark.parametrize("count", [1000, 9000])
def test_a_large_run_stays_small(run: Path, count: int) -> None:
    """As many episodes, each with a filmstrip of maximum size."""
    strip = Filmstrip(jpeg=bytes(MAX_STRIP_BYTES), camera="front", moments=8, width=800, height=100)
    report = gather(run)
    many = tuple(replace(report.episodes[number % 4], filmstrip=strip) for number in range(count))
    text = page(replace(report, episodes=many))
    assert 15_000_000 < len(text.encode()) < MOST_BYTES
    assert text.count("<article ") == min(count, MAX_SHOWN)
    assert text.count(' class="failed">') == min(count // 4, MAX_SHOWN)
    assert f"{3 * count // 4} of {count} attempts succeeded" in text


def test_distributions_are_drawn_from_frames_and_extremes() -> None:
    """Every fifth of 1,000 values, the extremes, and no value that is not finite."""
    values = np.stack([np.arange(1000.0), np.full(1000, 7.0)], axis=1)
    values[500, 0] = np.nan
    found: Components = {}
    add_motion(found, find_roles({"action": Column("float64", ("rising", "constant"))}, NO_NAMES), {"action": values})
    (rising,), (constant,) = found["action", "rising"], found["action", "constant"]
    assert (rising.min(), rising.max(), len(rising)) == (0, 999, 202)
    chart = distribution("rising", {"action": rising})
    assert (chart.low, chart.high, chart.note) == ("0", "999", f"mean: action {rising.mean():.3g}")
    assert chart.paths[0][1].count("V") == 49
    assert distribution("constant", {"action": constant}).middle == "7"


def test_unreadable_inputs_are_reported(run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    file = folder / "episodes" / "episode_000002.mcap"
    file.write_bytes(file.read_bytes()[:2000])
    found = report_on(folder)
    assert found.articles[0].startswith("episode_000002")
    assert "unreadable" in found.articles[0]
    assert len(found.articles) == 4


def test_refusals(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        ((run, "--out", tmp_path / "x.pdf"), "--out names an .html file"),
        ((run, "--out", tmp_path / "no" / "x.html"), "is missing"),
        ((run, "--out", tmp_path / "x.html", "--no-checks", "--images"), "leave one of them out"),
    ):
        assert exit_code("report", *arguments) == 2
        assert words in capsys.readouterr().err
    write_episode(tmp_path / "one.mcap", num_frames=3, cameras=())
    assert exit_code("report", tmp_path / "one.mcap", "--no-checks", "--out", tmp_path / "x.html") == 0
    assert capsys.readouterr().out.startswith("1 episode, ")

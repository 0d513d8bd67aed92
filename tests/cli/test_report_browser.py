"""A report in a real browser: opened from its file, at two widths, light and dark, with hostile text in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import exit_code
from support.export import make_run
from support.mcap import rewritten
from support.viewer import Chromium, chromium, need_chromium, num_colors, pixels

from demorec.mcap import Recording

HOSTILE = "<script>document.title = 'taken'</script><img src=x onerror=\"document.title = 'taken'\">"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on six episodes: one failed, and the text of one would be markup if it were not escaped."""
    folder = make_run(tmp_path_factory.mktemp("browser") / "cubes", (24,) * 5, failures=(1,), cameras=("front",))
    file = folder / "episodes" / "episode_000004.mcap"
    with Recording(file) as recording:
        found = recording._container.metadata("demorec.episode")
    assert found is not None
    info = json.loads(found["info"])
    info["instruction"] = HOSTILE
    file.write_bytes(rewritten(file, change={"demorec.episode": {"info": json.dumps(info)}}))
    out = folder.parent / "cubes.html"
    assert exit_code("report", folder, "--no-checks", "--out", out) == 0
    return out


def show(page: Chromium, path: Path, *, width: int, scheme: str) -> dict[str, Any]:
    """Open a page and report its state."""
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 500)
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    page.call("Page.navigate", url=path.as_uri())
    page.value("new Promise(done => document.readyState == 'complete' ? done() : addEventListener('load', done))")
    page.value(
        "document.querySelector('article').scrollIntoView(); Promise.all([...document.images].map(i => i.decode()))"
    )
    told = page.value(
        """JSON.stringify({
            title: document.title,
            episodes: document.querySelectorAll('article').length,
            images: [...document.images].filter(image => image.naturalWidth > 0).length,
            foreign: [...document.querySelectorAll('p')].filter(p => p.textContent.startsWith('<script>')).length,
            wide: document.documentElement.scrollWidth > innerWidth,
            loaded: performance.getEntriesByType('resource').filter(e => !e.name.startsWith('data:')).length,
        })"""
    )
    result: dict[str, Any] = json.loads(told)
    return result


@pytest.mark.slow  # Chromium takes seconds; tests/unit/test_report.py reads the same page with a parser
@pytest.mark.viewer
def test_a_browser_shows_it_and_runs_no_foreign_code(report: Path) -> None:
    program = need_chromium()
    brightness = {}
    with chromium(program, "about:blank") as page:
        page.call("Page.enable")
        for width in (1280, 400):
            for scheme in ("light", "dark"):
                assert show(page, report, width=width, scheme=scheme) == {
                    "title": "cubes: demorec report",
                    "episodes": 6,
                    "images": 6,
                    "foreign": 1,
                    "wide": False,
                    "loaded": 0,
                }
                image = pixels(page.image())
                assert num_colors(image) > 100
                brightness[scheme] = float(np.median(image))
        assert brightness["dark"] < 60 < 200 < brightness["light"]
        # The page's content security policy would block markup even if escaping had been forgotten.
        page.value("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"document.title = 1\">')")
        page.value(
            "document.body.append(Object.assign(document.createElement('script'), {text: 'document.title = 2'}))"
        )
        page.value("new Promise(done => setTimeout(done, 200))")
        assert page.value("document.title") == "cubes: demorec report"

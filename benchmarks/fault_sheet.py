"""The gallery of docs/checks.md: twelve faults, each beside what is good, and below it what the report says of it.

python benchmarks/fault_sheet.py --out docs/images/faults.png
"""

from __future__ import annotations

import argparse
import tempfile
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faults
import image_faults
import numpy as np
from check_limits import record
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from support.faults import Changed

from demorec.check.base import Result
from demorec.check.episode import CheckedEpisode
from demorec.core.config import GenerateConfig
from demorec.report.page import measured

GOOD = GenerateConfig(task="pick_place", variation="mild", seed=505, fps=20, width=192, height=144, depth=True)
OF_NUMBERS: dict[str, Callable[[Changed], Any]] = {
    "velocities 8 % too small": lambda c: c.columns.joint_velocity[:, 1],
    "wrench two frames late": lambda c: c.columns.sensed["wrench"][:, 4],
    "efforts of two light joints exchanged": lambda c: c.columns.joint_effort[:, 4],
    "contact force four frames late": lambda c: c.columns.contact_force,
    "an object slips by 15 mm": lambda c: np.maximum(
        c.columns.object_poses[faults.goal_object(c)][:, 2] - c.columns.base_from_tcp[:, 2], -0.03
    ),
    "ten frames cut out": lambda c: c.columns.joint_position[:, 1],
}
"""Fault of benchmarks/faults.py -> what is plotted of it."""
OF_IMAGES = (
    *(("color", name) for name in ("BT.709 for BT.601", "blurred by 0.6 px", "a dark spot of 5 px")),
    *(("color", name) for name in ("half a pixel to the right", "a third of the frame before")),
    ("depth", "2 cm too far"),
)
"""Faults of benchmarks/image_faults.py."""
RED, GREY = "#c62828", "#9e9e9e"
HIGH, WIDE = 64, 80
"""Pixels of an image that are shown."""


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A fault.

    Attributes:
        name: Of it.
        result: Of the check that is farthest beyond its limit.
        draw: Draws it.
    """

    name: str
    result: Result
    draw: Callable[[Axes], None]


def worst(found: Mapping[str, Result]) -> Result:
    """The failure farthest beyond its limit."""
    failed = [result for result in found.values() if result.level == "fail"]
    return max(failed, key=lambda result: (result.value or 0.0) / (result.fail or 1e-9))


def tiles_of_numbers(path: Path) -> list[Tile]:
    """Of the numbers: the good ones in grey, the others in red."""
    known, tiles = dict(faults.SIMULATED), []
    for name, shown in OF_NUMBERS.items():
        with faults.InMemory(path) as episode:
            recording = episode.recording
            assert recording.outcome is not None
            good = Changed(columns=recording.columns(), info=recording.info, outcome=recording.outcome)
            changed = known[name](good)
            episode.__dict__["columns"] = changed.columns
            recording.info, recording.outcome = changed.info, changed.outcome
            result = worst(faults.judge(episode))
        rows, spoilt = shown(good), shown(changed)

        def draw(axes: Axes, rows: Any = rows, spoilt: Any = spoilt, result: Result = result) -> None:
            axes.plot(rows, color=GREY, linewidth=2.5)
            axes.plot(spoilt, color=RED, linewidth=1)
            if result.frame is not None:
                axes.axvline(result.frame, color=RED, linewidth=0.6, linestyle=":")
            axes.set_xlim(0, len(rows) - 1)
            axes.tick_params(labelsize=6, colors="#757575")

        tiles.append(Tile(name=name, result=result, draw=draw))
    return tiles


def tiles_of_images(path: Path) -> list[Tile]:
    """Of the images: a part of a good one, and of the other; of depth, one column of pixels."""
    tiles = []
    with CheckedEpisode(path) as episode:
        good = {("front", "color"): image_faults.drawn_images(episode)["front"]}
        good["front", "depth"] = np.stack(list(episode.recording.depth("front")))
    for kind, name in OF_IMAGES:
        known = image_faults.COLOR if kind == "color" else image_faults.DEPTH
        rows = good["front", kind]
        spoilt = known[name](rows)
        result = worst({result.check: result for result in image_faults.judge(path, {("front", kind): spoilt})})
        where = part(spoilt, rows)

        def draw(axes: Axes, kind: str = kind, where: Any = where, rows: Any = rows, spoilt: Any = spoilt) -> None:
            if kind == "depth":
                middle = rows.shape[2] // 2
                axes.plot(rows[0, -60:, middle], color=GREY, linewidth=2.5)
                axes.plot(spoilt[0, -60:, middle], color=RED, linewidth=1)
                axes.tick_params(labelsize=6, colors="#757575")
                return
            gap = np.full((HIGH, 2, 3), 255, np.uint8)
            axes.imshow(np.hstack([rows[where], gap, spoilt[where]]), interpolation="nearest")
            axes.set_axis_off()

        tiles.append(Tile(name=f"depth {name}" if kind == "depth" else name, result=result, draw=draw))
    return tiles


def part(spoilt: Any, good: Any) -> Any:
    """Frame, rows and columns of the image that differs most, around where it does."""
    off = np.abs(spoilt.astype(np.float32) - good).reshape(*good.shape[:3], -1).sum(axis=3)
    frame = int(np.argmax(off.sum(axis=(1, 2))))
    y, x = np.unravel_index(int(np.argmax(off[frame])), off[frame].shape)
    height, width = off[frame].shape
    top, left = int(np.clip(y - HIGH // 2, 0, height - HIGH)), int(np.clip(x - WIDE // 2, 0, width - WIDE))
    return frame, slice(top, top + HIGH), slice(left, left + WIDE)


def main() -> None:
    """Record, spoil, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/faults.png"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.mcap"
        assert record(GOOD, 0, path)
        tiles = [*tiles_of_images(path), *tiles_of_numbers(path)]
    figure = Figure(figsize=(13, 7.2), dpi=100)
    for axes, tile in zip(figure.subplots(3, 4).flat, tiles, strict=True):
        tile.draw(axes)
        axes.set_title(tile.name, fontsize=9, loc="left")
        value, allowed, where = measured(tile.result)
        text = f"{tile.result.level}  {tile.result.check}: {value} (allowed {allowed})"
        lines = [text, *textwrap.wrap(where, 52)[:1]]
        axes.text(0, -0.14, "\n".join(lines), transform=axes.transAxes, fontsize=7.5, va="top", color=RED)
        print(f"{tile.name}: {text}; {where}")
    figure.tight_layout(h_pad=2.5)
    figure.savefig(options.out)
    image = Image.open(options.out).convert("RGB").quantize(128)
    image.save(options.out, optimize=True)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

"""Sheets of images for the docs: every task at its grasp and at its end, and many appearances of one task.

python benchmarks/images.py --out docs/images
"""

from __future__ import annotations

import argparse
import textwrap
from itertools import batched
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.tables import TASKS
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare

Pixels = NDArray[np.uint8]
WIDTH, HEIGHT = 320, 240
CAPTION_LETTERS = 48
CARRYING = {"lift", "transport", "hold"}
"""Phases at which a grasp is shown; for tasks without lifting, the first contact is shown."""
EPISODES = {"line_up": 2}
"""Tasks that show another episode than the first, because there the hand hides an object at the end."""


def grasp_and_end(config: GenerateConfig, index: int) -> tuple[Pixels, Pixels, str]:
    """The front camera's images at the first grasp and at the end of an episode, and its instruction."""
    episode = prepare(EpisodePlan(config=config, episode_index=index))
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(episode.info)
        frames = list(Session.of_episode(world, episode, renderer).run(ScriptAgent(episode)))
    held = min(frames, key=lambda f: (f.phase not in CARRYING, not f.observation.contact_force, f.frame_index))
    return held.images["front"].color, frames[-1].images["front"].color, episode.info.instruction


def sheet(rows: list[list[tuple[Pixels, str]]]) -> Image.Image:
    """Rows of captioned images; long captions take several lines."""
    lines = max(len(textwrap.wrap(caption, CAPTION_LETTERS)) for row in rows for _, caption in row)
    line = 3 + 15 * lines
    columns = max(len(row) for row in rows)
    canvas = Image.new("RGB", (columns * WIDTH, len(rows) * (HEIGHT + line)), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=12)
    for y, row in enumerate(rows):
        for x, (image, caption) in enumerate(row):
            canvas.paste(Image.fromarray(image), (x * WIDTH, y * (HEIGHT + line)))
            text = textwrap.fill(caption, CAPTION_LETTERS)
            draw.text((x * WIDTH + 4, y * (HEIGHT + line) + HEIGHT + 2), text, fill="black", font=font, spacing=2)
    return canvas


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    def config(task: str, variation: str) -> GenerateConfig:
        return GenerateConfig(
            task=task,
            seed=args.seed,
            cameras=("front",),
            width=WIDTH,
            height=HEIGHT,
            variation=variation,  # type: ignore[arg-type]
        )

    cells: list[list[tuple[Pixels, str]]] = []
    for task in TASKS.names():
        held, end, instruction = grasp_and_end(config(task, "mild"), EPISODES.get(task, 0))
        cells.append([(held, f"{task}: {instruction}"), (end, f"{task}, end")])
    pairs = [[cell for task in two for cell in task] for two in batched(cells, 2)]
    sheet(pairs).save(args.out / "tasks.jpg", quality=88)
    looks = [(grasp_and_end(config("pick_place", "full"), index)[0], f"look {index}") for index in range(16)]
    sheet([looks[i : i + 4] for i in range(0, 16, 4)]).save(args.out / "looks.jpg", quality=88)


if __name__ == "__main__":
    main()

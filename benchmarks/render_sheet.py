"""Draw the labelled sheet of docs/rendering.md: both cameras by every available renderer, at three sizes."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from render import painter_for, plan, run_episode

from demorec.core.errors import RenderError
from demorec.core.tables import RENDERERS
from demorec.loop import make_world

SIZES = ((96, 96), (224, 224), (640, 480))
TILE_HEIGHT = 240
LABEL_HEIGHT = 20


def tile(image: Image.Image, label: str) -> NDArray[np.uint8]:
    """Scale an image to the height of a row, with its label above."""
    width = round(TILE_HEIGHT * image.width / image.height)
    filtering = Image.Resampling.NEAREST if image.height < TILE_HEIGHT else Image.Resampling.LANCZOS
    canvas = Image.new("RGB", (width, LABEL_HEIGHT + TILE_HEIGHT), "white")
    canvas.paste(image.resize((width, TILE_HEIGHT), filtering), (0, LABEL_HEIGHT))
    ImageDraw.Draw(canvas).text((4, 3), label, fill="black", font=ImageFont.load_default(size=12))
    return np.asarray(canvas)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/renderers.png"))
    parser.add_argument("--frame", type=int, default=90)
    options = parser.parse_args()
    episode = plan(width=96, height=96)
    rows = []
    with make_world(episode.info) as world:
        state = run_episode(world, episode)[options.frame]
        world.set_state(joint_position=state.joint_position, object_poses=state.object_poses)
        for name in RENDERERS.names():
            row = []
            try:
                with RENDERERS.load(name)() as renderer:
                    for width, height in SIZES:
                        cameras = tuple(
                            replace(c, width=width, height=height) for c in episode.info.simulated.scene.cameras
                        )
                        painter = painter_for(renderer, world, cameras, antialias=True, everything=False)
                        for camera, images in painter.images().items():
                            label = f"{name}, {camera} camera, {width}x{height}"
                            row.append(tile(Image.fromarray(images.color), label))
            except RenderError as error:
                print(f"{name} is left out: {error}")
                continue
            rows.append(np.hstack(row))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    sheet = Image.fromarray(np.vstack(rows))
    sheet.save(options.out, optimize=True)
    print(f"{', '.join(RENDERERS.names())} from the top; {options.out.stat().st_size / 1e3:.0f} kB: {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

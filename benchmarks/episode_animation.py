"""The animation at the top of README.md: an episode of stack_three by two cameras, above the bar of its phases.

generate-dataset --task stack_three --num-episodes 1 --seed 3 --width 480 --height 360 --crf 15 --no-export --out RUN
python benchmarks/episode_animation.py RUN/episodes/episode_000000.mcap docs/images/episode.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from demorec.mcap import Recording
from demorec.view.style import name_colors

WIDTH, HEIGHT, GAP, BAR = 480, 360, 4, 32
SHOWN_SIZE = (723, 297)
EVERY, MILLISECONDS = 3, 100
HELD = 8
"""Number of times that the last image is repeated, so that the end is visible."""
DARK = (24, 28, 34)


def draw_bar(canvas: Image.Image, phases: list[str], frame: int) -> None:
    """Draw the phases over time, the current time, and the name of the current phase."""
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=17)
    colors, width, top = name_colors(phases), canvas.width, HEIGHT + GAP
    for index, phase in enumerate(phases):
        left, right = index * width // len(phases), (index + 1) * width // len(phases)
        draw.rectangle((left, top, right, top + BAR), fill=colors[phase])
    now = frame * width // len(phases)
    draw.rectangle((now - 2, top, now + 2, top + BAR), fill="white")
    length = int(draw.textlength(phases[frame], font=font))
    left = min(max(now + 8, 4), width - length - 8)
    draw.rectangle((left - 4, top + 4, left + length + 4, top + BAR - 4), fill=DARK)
    draw.text((left, top + 5), phases[frame], font=font, fill="white")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("recording", type=Path, help="with the cameras front and wrist of 480x360")
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    shown: list[Image.Image] = []
    with Recording(args.recording) as recording:
        phases = recording.phases
        images = zip(recording.images("front"), recording.images("wrist"), strict=True)
        for frame, pair in enumerate(images):
            if frame % EVERY:
                continue
            canvas = Image.new("RGB", (2 * WIDTH + GAP, HEIGHT + GAP + BAR), DARK)
            for place, image in enumerate(pair):
                canvas.paste(Image.fromarray(image), (place * (WIDTH + GAP), 0))
            draw_bar(canvas, list(phases), frame)
            shown.append(canvas.resize(SHOWN_SIZE, Image.Resampling.LANCZOS))
    shown += [shown[-1]] * HELD
    shown[0].save(
        args.out, save_all=True, append_images=shown[1:], duration=MILLISECONDS, loop=0, quality=55, method=6, kmax=60
    )


if __name__ == "__main__":
    main()

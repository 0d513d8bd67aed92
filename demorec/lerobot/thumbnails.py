"""The sheet of thumbnails in a dataset's card: some episodes, each from its first to its last picture, labelled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from demorec.export.staging import sync_file
from demorec.lerobot.layout import DatasetInfo
from demorec.lerobot.paths import SIDECAR_DIR
from demorec.lerobot.reader import episode_places
from demorec.lerobot.stills import pictures_at
from demorec.safety.text import printable
from demorec.scene.features import IMAGE_PREFIX

THUMBNAILS_PATH = f"{SIDECAR_DIR}/thumbnails.jpg"

_EPISODES, _MOMENTS, _SIDE, _LABEL, _GAP = 4, 5, 160, 18, 2


def write_thumbnails(root: Path, info: DatasetInfo) -> bool:
    """A labelled row per episode, from its first to its last picture; False for a dataset without cameras."""
    key = next((name for name, item in info.features.items() if item.is_video and not item.is_depth), None)
    if key is None:
        return False
    wanted = set(np.linspace(0, info.total_episodes - 1, _EPISODES).round().astype(int).tolist())
    places = [place for place in episode_places(root, info) if place.episode_index in wanted]
    height, width, _ = info.features[key].shape
    scale = _SIDE / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    sheet = Image.new("RGB", ((size[0] + _GAP) * _MOMENTS - _GAP, (size[1] + _LABEL) * len(places)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    for row, place in enumerate(places):
        top = row * (size[1] + _LABEL)
        label = f"episode {place.episode_index}, camera {key.removeprefix(IMAGE_PREFIX)}: {', '.join(place.tasks)}"
        draw.text((4, top + 1), printable(label), fill="black", font=font)
        moments = np.linspace(0, place.length - 1, _MOMENTS).round().astype(int).tolist()
        for column, picture in enumerate(pictures_at(root, info, key, place, moments)):
            corner = column * (size[0] + _GAP), top + _LABEL
            sheet.paste(Image.fromarray(picture).resize(size, reducing_gap=1.0), corner)
            time = f"{moments[column] / info.fps:.1f} s"
            left, above, right, below = draw.textbbox((corner[0] + 4, corner[1] + 1), time, font=font)
            draw.rectangle((left - 3, above - 2, right + 2, below + 2), fill="black")
            draw.text((corner[0] + 4, corner[1] + 1), time, fill="white", font=font)
    path = root / THUMBNAILS_PATH
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    sheet.save(path, quality=85)
    sync_file(path)
    return True

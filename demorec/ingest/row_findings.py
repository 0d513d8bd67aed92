"""What is odd in the rows that were made of a bag: their rate, and images that are in two of them or in none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from demorec.ingest.clock import NS
from demorec.ingest.findings import LOST, NOTE, Finding, of_stream
from demorec.ingest.rows import RATE, EpisodeRows, Timelines


def row_findings(lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[Finding]:
    """What is odd in the rows of a bag's episodes, each thing once."""
    fps = lines.mapping.clock.fps
    for rows in (rows for rows in episodes if rows.follows and len(rows.times_ns) > 1):
        steps = np.diff(rows.times_ns)
        rate = NS / float(steps[steps <= LOST * np.median(steps)].mean())
        if abs(rate - fps) > RATE * fps:
            text = f"rows follow its messages, {rate:.1f} a second, fps says {fps}"
            yield Finding(kind="fps", stream=rows.follows, text=text)
            break
    for name in lines.mapping.cameras if episodes else ():
        yield from _use_findings(name, lines, episodes)


def _use_findings(name: str, lines: Timelines, episodes: Sequence[EpisodeRows]) -> Iterator[Finding]:
    """What becomes of a camera's images: a finding where rows could show more of them, else a note."""
    line, clock = lines.lines[name], lines.mapping.clock
    num_repeated = num_free = num_skipped = num_images = 0
    for rows in episodes:
        shown = lines.chosen(name, rows.times_ns).index
        steps = np.diff(shown)
        repeated = shown[1:][steps == 0]
        num_repeated += len(repeated)
        # Not those where an image is missing, or the stream is at its end; and an episode may begin between two images.
        repeated = repeated[repeated < len(line.times_ns) - 1]
        waits = line.times_ns[repeated + 1] - line.times_ns[repeated]
        num_free += max(0, int(np.sum(waits <= LOST * line.period_ns)) - 1)
        num_skipped += int(np.maximum(steps - 1, 0).sum())
        num_images += int(shown[-1] - shown[0]) + 1
    num_rows = sum(len(rows.times_ns) for rows in episodes)
    rate = NS / max(line.period_ns, 1)
    repeats = f"{100 * num_repeated / num_rows:.3g} % of the rows show the image before"
    skips = f"{100 * num_skipped / num_images:.3g} % of its images are in no row"
    if min(num_free, num_skipped):  # where a row repeats and another skips, other rows would lose nothing
        advice = 'use rows = "camera"'
        if abs(rate - clock.fps) > max(RATE * clock.fps, 0.5):
            advice = f"use fps = {max(1, round(rate))}"
        elif clock.rows == "camera":
            advice = "they come too unevenly for these rows"
        yield of_stream(line.stream, "repeats", f"{repeats} and {skips}: {advice}")
    elif max(num_free / num_rows, num_skipped / num_images) > RATE:
        told = f"{repeats if num_free else skips}, since it comes {rate:.1f} times a second and rows {clock.fps} times"
        # Every second image can be meant; now the next one and now the one after it only beside a slower camera.
        is_uneven = abs(rate / clock.fps - round(rate / clock.fps)) > RATE
        if num_skipped and is_uneven and not any(rows.follows for rows in episodes):
            yield of_stream(line.stream, "skips", f"{told}: use fps = {max(1, round(rate))}")
        else:
            yield of_stream(line.stream, NOTE, told)
    elif num_skipped and (follows := next((rows.follows for rows in episodes if rows.follows), "")):
        yield of_stream(line.stream, NOTE, f"{skips}: rows follow {follows}")

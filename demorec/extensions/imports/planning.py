"""Read and judge a bag as a whole: plan its episode, and report all findings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from demorec.core.config import VideoConfig
from demorec.episode.episode import MAX_STAMP_NS
from demorec.episode.info import Camera, EpisodeInfo, Feature, SourceFile
from demorec.episode.validity import find_problems
from demorec.extensions.imports.bag import NS, Bag, Files
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.description import imported_feature, imported_info
from demorec.extensions.imports.fields import FieldError
from demorec.extensions.imports.findings import ImportFinding, bag_findings, row_findings
from demorec.extensions.imports.import_file import BagReport, stream_figures
from demorec.extensions.imports.mapping import SourceMapping
from demorec.extensions.imports.rows import EpisodeRows, TakenImages, Timelines
from demorec.extensions.imports.streams import read_streams
from demorec.extensions.imports.words import stated_task
from demorec.mcap.video import size_problem


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedBag:
    """A bag that has been read, and its episode."""

    bag: Bag
    report: BagReport
    info: EpisodeInfo
    rows: EpisodeRows


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """Settings of an import; `urdf` is None if the mapping names no file."""

    mapping: SourceMapping
    urdf: str | None
    video: VideoConfig


def plan_bag(bag: Bag, files: Files, settings: ImportSettings, *, episode_index: int) -> PlannedBag:
    """Read and judge a bag, which becomes the episode of this number in its run.

    Raises:
        BagError: It cannot be read, does not fit the mapping, or would yield an incomplete episode.
    """
    streams = read_streams(bag, settings.mapping)
    try:
        lines = Timelines(streams, settings.mapping)
        findings = bag_findings(lines)
        try:
            rows = lines.rows()
        except BagError as error:
            raise BagError(f"The bag yields no complete episode: {error}{_reported(findings)}") from error
        info = _info(bag, files, lines, rows, settings, episode_index)
        if wrong := list(_problems(info, rows, settings.video)):
            raise FieldError("; ".join(wrong))
    except FieldError as error:
        raise BagError(f"The episode cannot be recorded: {error}: {bag.path}") from error
    except BagError as error:
        raise BagError(f"{error}: {bag.path}") from error
    times_ns, begin_ns = rows.table.time_ns, lines.begin_ns
    report = BagReport(
        name=bag.path.name,
        files=files,
        num_bytes=bag.num_bytes,
        streams=tuple(stream_figures(line, times_ns) for line in lines.lines.values()),
        findings=(*findings, *row_findings(lines, rows)),
        episode_index=episode_index,
        begin_s=(int(times_ns[0]) - begin_ns) / NS,
        end_s=(int(times_ns[-1]) - begin_ns) / NS,
        num_frames=len(times_ns),
        pictures={name: images.described() for name, images in rows.cameras.items()},
        follows=rows.follows,
    )
    return PlannedBag(bag=bag, report=report, info=info, rows=rows)


def _reported(findings: Sequence[ImportFinding]) -> str:
    """Other findings in a bag without a complete episode, as possible causes; a clock's offset with its remedy."""
    texts = {finding.kind: finding.text for finding in reversed(findings)}
    kinds = [f"{kind}, {text}" if kind == "clock_offset" else kind for kind, text in sorted(texts.items())]
    return f" (the bag's report: {'; '.join(kinds)})" if kinds else ""


def _info(
    bag: Bag, files: Files, lines: Timelines, rows: EpisodeRows, settings: ImportSettings, episode_index: int
) -> EpisodeInfo:
    """Describe the episode; BagError or FieldError if the bag has no robot description or task."""
    mapping, urdf = settings.mapping, settings.urdf
    if topic := mapping.robot.urdf_topic:
        urdf = lines.streams.urdf
        if not isinstance(urdf, str) or not urdf.strip():
            raise BagError(f"{topic} holds no robot description")
    return imported_info(
        mapping,
        episode_index=episode_index,
        instruction=stated_task(mapping.task, bag.name),
        urdf=urdf,
        fps=mapping.clock.fps,
        features=(_feature(name, values.dtype, lines) for name, values in rows.table.features.items()),
        cameras=(_camera(name, plan, lines) for name, plan in rows.cameras.items()),
        files=(SourceFile(name=name, sha256=sha256) for name, sha256 in files),
    )


def _feature(name: str, dtype: DTypeLike, lines: Timelines) -> Feature:
    sources = lines.mapping.features[name]
    places = [f"{one.next} of the next frame" if one.next else f"{one.topic} {one.field}" for one in sources]
    streams = [lines.lines[key].stream for key, _ in lines.sources(name)]
    names = tuple(element for stream in streams for element in stream.names)
    units = (stream.unit for stream in streams for _ in stream.names)
    return imported_feature(name, dtype, names, units, called=names, source="; ".join(places))


def _camera(name: str, plan: TakenImages, lines: Timelines) -> Camera:
    info = lines.streams.infos.get(name, {})
    matrix, distortion = _numbers(info, "k", "K"), _numbers(info, "d", "D")
    width, height = plan.head.width, plan.head.height
    fits = (info.get("width") or width, info.get("height") or height) == (width, height)
    known = fits and len(matrix) == 9 and matrix[0] > 0 and bool(np.isfinite(matrix).all())
    return Camera(
        name=name,
        width=width,
        height=height,
        kept=plan.kept,
        intrinsics=tuple(matrix) if known else None,
        distortion=tuple(distortion) if known and len(distortion) == 5 and np.isfinite(distortion).all() else (),
        source=plan.topic,
    )


def _numbers(values: Mapping[str, Any], *keys: str) -> list[float]:
    """Numbers in the first of these fields that exists."""
    found = next((values[key] for key in keys if key in values), None)
    return [float(number) for number in found.reshape(-1)] if isinstance(found, np.ndarray) and found.size <= 64 else []


def _problems(info: EpisodeInfo, rows: EpisodeRows, video: VideoConfig) -> Iterator[str]:
    """Problems that prevent a recording, found before anything of the bag is written."""
    yield from find_problems(info)
    for name, plan in rows.cameras.items():
        if not plan.kept and (problem := size_problem(video, plan.head.width, plan.head.height)):
            yield f"camera {name}: {problem}"
    table = rows.table
    for stamps in (table.time_ns, *table.stamps.values(), *table.image_stamps.values()):
        if len(stamps) and not 0 <= stamps.min() <= stamps.max() <= MAX_STAMP_NS:
            yield f"a message has the time {stamps.min() / NS:.0f} s, allowed are 0 to {MAX_STAMP_NS // NS} s"
            return

"""What a person and a program read of recordings that were made again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.replay.deep import DeepReport

_SHOWN = 12
"""Differences of one recording that are printed: the first ones tell the most."""


def deep_lines(report: DeepReport, *, verbose: bool = False) -> Iterator[str]:
    """One line about a recording, below it the versions that differ, then what differs, the first frames first."""
    yield f"{report.level:<4}  made again {report.path}: {_verdict(report)}"
    details = [*report.versions]
    if report.error:
        details.append(f"It cannot be made again: {report.error}")
    shown = report.differences if verbose else report.differences[:_SHOWN]
    details += [str(difference) for difference in shown]
    if len(report.differences) > len(shown):
        details.append(f"and {len(report.differences) - len(shown)} fields more (--verbose shows all)")
    if report.replay:
        details.append(f"Replayed: {report.replay}")
    yield from (f"      {detail}" for detail in details)


def _verdict(report: DeepReport) -> str:
    if report.error:
        return "not possible"
    if not report.differences:
        aside = "; labels, phases and events are taken over in a derived recording" if report.is_derived else ""
        return f"the same to the bit in all {report.num_frames} frames{aside}"
    frames = {frame for difference in report.differences for frame in difference.frames}
    return f"{len(report.differences)} fields differ, in {len(frames)} of {report.num_frames} frames"


def deep_summary(remade: Sequence[DeepReport], different: Sequence[DeepReport]) -> str:
    """The end of the last line: how many were made again, how many of them differ, how many cannot be; "" for none.

    Args:
        remade: All that were tried.
        different: Those among them that count as failed; what cannot be made again is one of them.
    """
    impossible = sum(bool(report.error) for report in remade)
    made, differ = len(remade) - impossible, sum(not report.error for report in different)
    warned = sum(report.level == "warn" for report in remade if not report.error)
    aside = f" ({warned} with a warning)" if warned else ""
    text = f" {made} made again{aside}, {differ} not as recorded." if made else ""
    return text + (f" {impossible} could not be made again." if impossible else "")


def plain_deep(report: DeepReport) -> dict[str, Any]:
    """The same as plain data for JSON, with every frame that differs."""
    from demorec.plain import to_plain

    plain = to_plain(report)
    return {"path": str(report.path), "kind": "deep", "level": report.level, "results": [
        {name: value for name, value in plain.items() if name != "path"}
    ]}  # fmt: skip

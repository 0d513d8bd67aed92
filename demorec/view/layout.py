"""Layout of the views: 3D next to the cameras, phases and curves below, all on the timeline of seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

from demorec.episode.features import ACTION, STATE
from demorec.view.episode import EFFORT_CURVES, FORCE_CURVES, Playback
from demorec.view.paths import FRAMES, SECONDS, Paths

BACKGROUND = (24, 27, 33)
_SIDE = ("gripper opening (m)", "contact force (N)")
_PLOTS: Mapping[str, tuple[str, ...]] = {
    "joints and their targets (rad)": ("position", "target"),
    "joint velocity (rad/s)": ("velocity",),
    "gripper position (m)": ("ee",),
    "gripper opening (m)": ("gripper", "gripper target"),
    "joint effort (N m)": (EFFORT_CURVES,),
    "contact force (N)": (FORCE_CURVES,),
}
"""Title -> curves of a simulated episode; those of `_SIDE` are next to the tabs of the others. Any other curve has a
separate plot: those of sensors in further tabs, the features of other episodes next to each other."""
_NOT_IN_3D: tuple[Literal["/depth", "/segmentation"], ...] = ("/depth", "/segmentation")
_FLOOR = 3.0
"""Minimum width, metres, of a body that counts as the floor, which would only hide the grid."""


def episode_layout(episode: Playback) -> rrb.Blueprint:
    """Build the layout of one episode, or of all with the same streams."""
    is_known = episode.scene is not None or bool(episode.info.urdf)
    three_d, cameras = [_view_3d(episode)] if is_known else [], _camera_views(episode)
    top: list[rrb.View | rrb.Container] = [*three_d]
    if three_d and cameras:
        top = [rrb.Horizontal(*three_d, rrb.Vertical(*cameras), column_shares=[2.0, 1.0])]
    elif cameras:
        top = [rrb.Horizontal(*cameras)]
    texts: list[rrb.View] = [rrb.TextDocumentView(origin=Paths.summary, name="episode")]
    if episode.statements:
        texts.insert(0, rrb.TextDocumentView(origin=Paths.words, name="in words"))
    if any(episode.data.phases) or any(episode.data.events()):
        texts.append(rrb.TextLogView(origin=Paths.events, name="events"))
    bottom = rrb.Horizontal(_curve_views(episode), rrb.Tabs(*texts, active_tab=0), column_shares=[2.6, 1])
    parts, shares = [*top, bottom], [*[5.0] * len(top), 2.6]
    if any(episode.data.phases):
        parts = [*top, rrb.StateTimelineView(origin=Paths.phase, name="phases"), bottom]
        shares = [*[4.6] * len(top), 0.95, 2.9]
    return rrb.Blueprint(
        rrb.Vertical(*parts, row_shares=shares),
        rrb.TimePanel(state="collapsed", timeline=SECONDS, fps=float(episode.info.fps), loop_mode="all"),
        rrb.BlueprintPanel(state="expanded"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _view_3d(episode: Playback) -> rrb.Spatial3DView:
    contents = [f"+ {Paths.world}/**"]
    for camera in episode.cameras:
        if episode.scene is None:  # its pose in the world is unknown
            contents.append(f"- {Paths.camera(camera)}/**")
        else:
            contents += [f"- {Paths.camera(camera, more)}" for more in _NOT_IN_3D]
    for body in () if episode.scene is None else episode.scene.bodies:
        if max(body.shape.extents) > _FLOOR:
            contents.append(f"- {Paths.body(body.name)}")
    past = [
        rrb.VisibleTimeRange(timeline, start=rrb.TimeRangeBoundary.infinite(), end=now)
        for timeline, now in (
            (SECONDS, rrb.TimeRangeBoundary.cursor_relative(seconds=0)),
            (FRAMES, rrb.TimeRangeBoundary.cursor_relative(seq=0)),
        )
    ]
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=episode.info.robot_name if episode.scene is None else f"{episode.info.simulated.task}: the world",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        spatial_information=rrb.SpatialInformation(target_frame="tf#/", show_axes=False),
        eye_controls=_eye(episode),
        overrides={Paths.ee_path: [rrb.VisibleTimeRanges(past), rr.LineStrips3D.from_fields()]},
    )


def _eye(episode: Playback) -> rrb.EyeControls3D | None:
    """Choose the 3D viewpoint: looking at the gripper's trajectory from the side, with the arm in view.

    None if the trajectory is unknown, so that the viewer chooses.
    """
    if episode.motion.base_from_tcp is None:
        return None
    base = episode.world_from_base
    points = base.apply(episode.motion.base_from_tcp[:, :3])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else base.apply((0.5, 0.0, 0.2))
    target = 0.7 * middle + 0.3 * base.apply((0.2, 0.0, 0.4))
    side = base.rotation[:, 1]
    forward = base.rotation[:, 0]
    eye = target + 0.15 * forward - 1.05 * side + (0.0, 0.0, 0.42)
    return rrb.EyeControls3D(
        kind=rrb.components.Eye3DKind.Orbital,
        position=eye.tolist(),
        look_target=target.tolist(),
        eye_up=(0.0, 0.0, 1.0),
    )


def _camera_views(episode: Playback) -> list[rrb.View | rrb.Container]:
    views: list[rrb.View | rrb.Container] = []
    for name in episode.cameras:
        tabs: list[rrb.View] = []
        if name in episode.videos:
            tabs.append(rrb.Spatial2DView(origin=Paths.camera(name), contents=["$origin"], name=f"{name} camera"))
        if name in episode.depth:
            tabs.append(rrb.Spatial2DView(origin=Paths.camera(name, "/depth"), name=f"{name} depth"))
        if name in episode.data.cameras and episode.data.has_segmentation(name):
            tabs.append(rrb.Spatial2DView(origin=Paths.camera(name, "/segmentation"), name=f"{name} segments"))
        if tabs:
            views.append(tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0))
    if len(views) > 3:
        return [rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))]
    return views


def _curve_views(episode: Playback) -> rrb.Container:
    known = {name for names in _PLOTS.values() for name in names}
    # A feature with an unusual name for its role has both in its title.
    roles = episode.roles.of.items()
    titles = {name: f"{role}: {name}" for name, role in roles if role is not None and name not in (STATE, ACTION)}
    tabs = [view for title in _PLOTS if title not in _SIDE for view in _curve_view(episode, title, _PLOTS[title])]
    beside = [view for title in _SIDE for view in _curve_view(episode, title, _PLOTS[title])]
    for name in episode.curves:
        if name not in known:
            (tabs or beside).extend(_curve_view(episode, titles.get(name, name), (name,)))
    columns: list[rrb.View | rrb.Container] = [rrb.Tabs(*tabs, active_tab=0)] if tabs else []
    columns += beside
    return rrb.Horizontal(*columns, column_shares=[1.8, *([1.0] * (len(columns) - 1))] if tabs else None)


def _curve_view(episode: Playback, title: str, names: tuple[str, ...]) -> list[rrb.TimeSeriesView]:
    """Build the plot of these curves; none if the episode lacks all of them."""
    shown = [name for name in names if name in episode.curves]
    if not shown:
        return []
    num_series = sum(len(episode.curves[name].names) for name in shown)
    legend = rrb.PlotLegend(
        rrb.Corner2D.RightTop if len(episode.curves[shown[0]].names) > 3 else rrb.Corner2D.LeftBottom,
        visible=num_series > 1,  # the title names a single one, and a legend would hide part of it
    )
    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    contents = [Paths.curves(name) for name in shown]
    return [rrb.TimeSeriesView(origin="/", contents=contents, name=title, axis_x=axis, plot_legend=legend)]

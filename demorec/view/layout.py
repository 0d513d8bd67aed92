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
from demorec.view.scene import DIFFERENCES, A, B

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
_COMPARED_PLOTS = {("joints (rad)" if "position" in names else title): names[:1] for title, names in _PLOTS.items()}
"""Plots of two overlaid episodes, without targets, which would hide the compared curves."""
_NOT_IN_3D: tuple[Literal["/depth", "/segmentation", "/boxes"], ...] = ("/depth", "/segmentation", "/boxes")
_FLOOR = 3.0
"""Minimum width, metres, of a body that counts as the floor, which would only hide the grid."""


def episode_layout(episode: Playback, *, is_alone: bool = False) -> rrb.Blueprint:
    """Build the layout of one episode, or of all with the same streams; a single one needs no list of episodes."""
    paths = Paths()
    title = episode.info.robot_name if episode.scene is None else f"{episode.info.simulated.task}: the world"
    is_known = episode.scene is not None or bool(episode.info.urdf)
    return _blueprint(
        episode,
        is_alone=is_alone,
        three_d=_view_3d(episode, [paths], title) if is_known else None,
        cameras=_camera_views(episode, paths),
        curves=_curve_views([paths], episode),
        states=[rrb.StateTimelineView(origin=paths.phase, name="phases")] if any(episode.data.phases) else [],
        texts=[
            *([rrb.TextDocumentView(origin=paths.words, name="in words")] if episode.statements else []),
            rrb.TextDocumentView(origin=paths.summary, name="episode"),
            *(
                [rrb.TextLogView(origin=paths.events, name="events")]
                if any(episode.data.phases) or any(episode.data.events())
                else []
            ),
        ],
    )


def comparison_layout(a: Playback, b: Playback) -> rrb.Blueprint:
    """Build the layout of two episodes in one recording: below /a and /b, with the same streams overlaid."""
    roots = [A, B]
    images: list[rrb.View | rrb.Container] = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=paths.camera(name), contents=["$origin"], name=f"{name} {label}")
                for paths, label in zip(roots, "AB", strict=True)
            )
        )
        for name in a.videos
        if name in b.videos
    ]
    return _blueprint(
        a,
        is_alone=True,
        three_d=_view_3d(a, roots, "A (white) and B (orange)"),
        cameras=images,
        curves=_curve_views(roots, a),
        states=[rrb.StateTimelineView(origin="/", contents=[paths.phase for paths in roots], name="phases A, B")],
        texts=[
            rrb.TextDocumentView(origin=roots[0].summary, name="A"),
            rrb.TextDocumentView(origin=roots[1].summary, name="B"),
            rrb.TextLogView(origin="/", contents=[paths.events for paths in roots], name="events"),
        ],
        more_curves=[
            rrb.TimeSeriesView(origin=f"{DIFFERENCES}/distance", name="distance of A and B (mm)"),
            rrb.TimeSeriesView(origin=f"{DIFFERENCES}/joints", name="joint difference (rad)"),
        ],
        images_share=1.5,
    )


def _blueprint(
    episode: Playback,
    *,
    is_alone: bool,
    three_d: rrb.View | None,
    cameras: list[rrb.View | rrb.Container],
    curves: rrb.Container,
    states: list[rrb.View],
    texts: list[rrb.View],
    more_curves: list[rrb.View] | None = None,
    images_share: float = 1.0,
) -> rrb.Blueprint:
    top: list[rrb.View | rrb.Container] = [] if three_d is None else [three_d]
    if three_d is not None and cameras:
        shares = [3.0 - images_share, images_share]
        top = [rrb.Horizontal(three_d, rrb.Vertical(*cameras), column_shares=shares)]
    elif cameras:
        top = [rrb.Horizontal(*cameras)]
    columns = [curves, *([rrb.Tabs(*more_curves, active_tab=0)] if more_curves else []), rrb.Tabs(*texts, active_tab=0)]
    bottom = rrb.Horizontal(*columns, column_shares=[2.6, *([1] * (len(columns) - 1))])
    parts, shares = [*top, bottom], [*[5.0] * len(top), 2.6]
    if states:
        parts = [*top, *states, bottom]
        shares = [*[4.6] * len(top), 0.95 if more_curves is None else 1.4, 2.9]
    return rrb.Blueprint(
        rrb.Vertical(*parts, row_shares=shares),
        rrb.TimePanel(state="collapsed", timeline=SECONDS, fps=float(episode.info.fps), loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed" if is_alone else "expanded"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _view_3d(episode: Playback, roots: list[Paths], name: str) -> rrb.Spatial3DView:
    contents = []
    for paths in roots:
        contents.append(f"+ {paths.world}/**")
        for camera in episode.cameras:
            if episode.scene is None:  # its pose in the world is unknown
                contents.append(f"- {paths.camera(camera)}/**")
                continue
            contents += [f"- {paths.camera(camera, more)}" for more in _NOT_IN_3D]
        for body in () if episode.scene is None else episode.scene.bodies:
            if max(body.shape.extents) > _FLOOR:
                contents.append(f"- {paths.body(body.name)}")
    behind = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(timeline, start=rrb.TimeRangeBoundary.infinite(), end=now)
            for timeline, now in (
                (SECONDS, rrb.TimeRangeBoundary.cursor_relative(seconds=0)),
                (FRAMES, rrb.TimeRangeBoundary.cursor_relative(seq=0)),
            )
        ]
    )
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        spatial_information=rrb.SpatialInformation(target_frame="tf#/", show_axes=False),
        eye_controls=_eye(episode),
        overrides={paths.ee_path: [behind, rr.LineStrips3D.from_fields()] for paths in roots},
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


def _camera_views(episode: Playback, paths: Paths) -> list[rrb.View | rrb.Container]:
    views: list[rrb.View | rrb.Container] = []
    for name in episode.cameras:
        is_recorded = name in episode.data.cameras
        boxes = [paths.camera(name, "/boxes")] if is_recorded and any(episode.data.boxes(name)) else []
        tabs: list[rrb.View] = []
        if name in episode.videos:
            contents = ["$origin", *boxes]
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name), contents=contents, name=f"{name} camera"))
        if name in episode.depth:
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name, "/depth"), name=f"{name} depth"))
        if is_recorded and episode.data.has_segmentation(name):
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name, "/segmentation"), name=f"{name} segments"))
        if tabs:
            views.append(tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0))
    if len(views) > 3:
        return [rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))]
    return views


def _curve_views(roots: list[Paths], episode: Playback) -> rrb.Container:
    def view(title: str, *names: str) -> rrb.TimeSeriesView | None:
        shown = [name for name in names if name in episode.curves]
        if not shown:
            return None
        num_series = len(roots) * sum(len(episode.curves[name].names) for name in shown)
        return rrb.TimeSeriesView(
            origin="/",
            contents=[paths.curves(name) for paths in roots for name in shown],
            name=title,
            axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
            plot_legend=rrb.PlotLegend(
                rrb.Corner2D.RightTop if len(episode.curves[shown[0]].names) > 3 else rrb.Corner2D.LeftBottom,
                visible=num_series > 1,  # the title names a single one, and a legend would hide part of it
            ),
        )

    plots = _PLOTS if len(roots) == 1 else _COMPARED_PLOTS
    known = {name for names in plots.values() for name in names} | {"target", "gripper target"}
    # A feature with an unusual name for its role has both in its title.
    roles = episode.roles.of.items()
    titles = {name: f"{role}: {name}" for name, role in roles if role is not None and name not in (STATE, ACTION)}
    tabs = [item for title, names in plots.items() if title not in _SIDE and (item := view(title, *names)) is not None]
    others = [view(titles.get(name, name), name) for name in episode.curves if name not in known]
    beside = [item for title in _SIDE if (item := view(title, *plots[title])) is not None]
    (tabs or beside).extend(item for item in others if item is not None)
    columns: list[rrb.View | rrb.Container] = [rrb.Tabs(*tabs, active_tab=0)] if tabs else []
    columns += beside
    return rrb.Horizontal(*columns, column_shares=[1.8, *([1.0] * (len(columns) - 1))] if tabs else None)

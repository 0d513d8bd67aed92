"""How the views are arranged: 3D beside the cameras, phases and curves below, all on the seconds' time line."""

from __future__ import annotations

import math

import rerun as rr
import rerun.blueprint as rrb

from demorec.core.geometry import Array
from demorec.view.compare import DIFFERENCES, A, B
from demorec.view.episode import PlayedEpisode, PlayedExternal
from demorec.view.paths import Paths
from demorec.view.times import FRAMES, SECONDS

BACKGROUND = (24, 27, 33)
_FLOOR = 3.0
"""Bodies wider than this (metres) are the floor, which would only hide the grid."""


def episode_layout(episode: PlayedEpisode | PlayedExternal, *, is_alone: bool = False) -> rrb.Blueprint:
    """The layout of one episode, or of all that have its streams; one that is alone needs no list of episodes."""
    if isinstance(episode, PlayedExternal):
        return _panels(_external_views(episode), episode.info.fps, is_alone=is_alone)
    paths = Paths()
    return _blueprint(
        episode,
        is_alone=is_alone,
        three_d=_view_3d(episode, [paths], f"{episode.info.task}: the world"),
        cameras=_camera_views(episode, paths),
        curves=_curve_views([paths], episode),
        states=[rrb.StateTimelineView(origin=paths.phase, name="phases")] if any(episode.phase) else [],
        texts=[
            *_pages(episode),
            rrb.TextLogView(origin=paths.events, name="events"),
        ],
    )


def comparison_layout(a: PlayedEpisode, b: PlayedEpisode) -> rrb.Blueprint:
    """The layout of two episodes in one recording: below /a and /b, the same streams over each other."""
    roots = [A, B]
    pictures: list[rrb.View | rrb.Container] = []
    for name in [name for name in a.videos if name in b.videos]:
        views = [
            rrb.Spatial2DView(origin=paths.camera(name), contents=["$origin"], name=f"{name} {label}")
            for paths, label in zip(roots, "AB", strict=True)
        ]
        pictures.append(rrb.Horizontal(*views))
    return _blueprint(
        a,
        is_alone=True,
        three_d=_view_3d(a, roots, "A (white) and B (orange)"),
        cameras=pictures,
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
        pictures_share=1.5,
    )


def _blueprint(
    episode: PlayedEpisode,
    *,
    is_alone: bool,
    three_d: rrb.View,
    cameras: list[rrb.View | rrb.Container],
    curves: rrb.Container,
    states: list[rrb.View],
    texts: list[rrb.View],
    more_curves: list[rrb.View] | None = None,
    pictures_share: float = 1.0,
) -> rrb.Blueprint:
    top: rrb.View | rrb.Container = three_d
    if cameras:
        top = rrb.Horizontal(three_d, rrb.Vertical(*cameras), column_shares=[3.0 - pictures_share, pictures_share])
    columns = [curves, *([rrb.Tabs(*more_curves, active_tab=0)] if more_curves else []), rrb.Tabs(*texts, active_tab=0)]
    bottom = rrb.Horizontal(*columns, column_shares=[2.6, *([1] * (len(columns) - 1))])
    parts, shares = [top, bottom], [5.0, 2.6]
    if states:
        parts, shares = [top, *states, bottom], [4.6, 0.95 if more_curves is None else 1.4, 2.9]
    return _panels(rrb.Vertical(*parts, row_shares=shares), episode.info.fps, is_alone=is_alone)


def _panels(views: rrb.Container, fps: int, *, is_alone: bool) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        rrb.TimePanel(state="collapsed", timeline=SECONDS, fps=float(fps), loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed" if is_alone else "expanded"),
        rrb.SelectionPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _pages(episode: PlayedEpisode | PlayedExternal) -> list[rrb.View]:
    """What is said of the episode, if anything is, and the episode in words."""
    pages = [rrb.TextDocumentView(origin=Paths().words, name="in words")] if episode.statements else []
    return [*pages, rrb.TextDocumentView(origin=Paths().summary, name="episode")]


def _external_views(episode: PlayedExternal) -> rrb.Container:
    """The robot, if it is known, beside the cameras; the features below."""
    paths = Paths()
    top: list[rrb.View | rrb.Container] = []
    if episode.info.urdf:
        top.append(rrb.Spatial3DView(origin="/", contents=[f"+ {paths.robot}/**"], name=episode.info.robot))
    top += [
        rrb.Spatial2DView(origin=paths.camera(camera), contents=["$origin"], name=camera) for camera in episode.videos
    ]
    top += [rrb.Spatial2DView(origin=paths.camera(camera, "/depth"), name=camera) for camera in episode.depth]
    plots = [
        rrb.TimeSeriesView(
            origin="/",
            contents=[paths.curves(name)],
            name=name,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        )
        for name in episode.curves
    ]
    # Without pictures above there is room for texts one below the other.
    texts = _pages(episode) if top else [rrb.Vertical(*_pages(episode))]
    bottom = rrb.Horizontal(*plots, *texts, column_shares=[1.6] * len(plots) + [1.0] * len(texts))
    return rrb.Vertical(rrb.Horizontal(*top), bottom, row_shares=[5.0, 3.0]) if top else bottom


def _view_3d(episode: PlayedEpisode, roots: list[Paths], name: str) -> rrb.Spatial3DView:
    contents = []
    for paths in roots:
        contents.append(f"+ {paths.world}/**")
        for camera in episode.info.scene.cameras:
            hidden = (
                paths.camera(camera.name, "/depth"),
                paths.camera(camera.name, "/segmentation"),
                paths.camera(camera.name, "/boxes"),
            )
            contents += [f"- {entity}" for entity in hidden]
        for body in episode.info.scene.bodies:
            if max(body.shape.extents) > _FLOOR:
                contents.append(f"- {paths.body(body.name)}")
    eye, target = _eye(episode)
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
        eye_controls=rrb.EyeControls3D(
            kind=rrb.components.Eye3DKind.Orbital,
            position=eye.tolist(),
            look_target=target.tolist(),
            eye_up=(0.0, 0.0, 1.0),
        ),
        overrides={paths.ee_path: [behind, rr.LineStrips3D.from_fields()] for paths in roots},
    )


def _eye(episode: PlayedEpisode) -> tuple[Array, Array]:
    """Where the 3D view looks from and to: at the gripper's way from the side, with the arm in the picture."""
    base = episode.info.scene.robot.world_from_base
    points = base.apply(episode.base_from_tcp[:, :3])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else base.apply((0.5, 0.0, 0.2))
    target = 0.7 * middle + 0.3 * base.apply((0.2, 0.0, 0.4))
    side = base.rotation[:, 1]
    forward = base.rotation[:, 0]
    return target + 0.15 * forward - 1.05 * side + (0.0, 0.0, 0.42), target


def _camera_views(episode: PlayedEpisode, paths: Paths) -> list[rrb.View | rrb.Container]:
    views: list[rrb.View | rrb.Container] = []
    for camera in episode.info.scene.cameras:
        name = camera.name
        boxes = [paths.camera(name, "/boxes")] if name in episode.boxes else []
        tabs: list[rrb.View] = []
        if name in episode.videos:
            contents = ["$origin", *boxes]
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name), contents=contents, name=f"{name} camera"))
        if name in episode.depth:
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name, "/depth"), name=f"{name} depth"))
        if name in episode.segmentation:
            tabs.append(rrb.Spatial2DView(origin=paths.camera(name, "/segmentation"), name=f"{name} segments"))
        if tabs:
            views.append(tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0))
    if len(views) > 3:
        return [rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))]
    return views


def _curve_views(roots: list[Paths], episode: PlayedEpisode) -> rrb.Container:
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

    joints = [
        view("joints (rad)", "position")
        if len(roots) > 1
        else view("joints and their targets (rad)", "position", "target"),
        view("joint velocity (rad/s)", "velocity"),
        view("joint effort (N m)", "effort"),
        view("gripper position (m)", "ee"),
        view("force on the hand (N)", "hand force"),
        view("torque on the hand (N m)", "hand torque"),
    ]
    side = [
        view("gripper opening (m)", "gripper", *(["gripper target"] if len(roots) == 1 else [])),
        view("contact force (N)", "force"),
    ]
    columns: list[rrb.View | rrb.Container] = []
    tabs = [item for item in joints if item is not None]
    if tabs:
        columns.append(rrb.Tabs(*tabs, active_tab=0))
    columns += [item for item in side if item is not None]
    return rrb.Horizontal(*columns, column_shares=[1.8, *([1.0] * (len(columns) - 1))] if tabs else None)

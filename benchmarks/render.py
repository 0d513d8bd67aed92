"""CPU time of an image by each renderer, on frames of a real episode, all measured in one interleaved run.

    python benchmarks/render.py                        # a quick look
    python benchmarks/render.py --rounds 11
    python benchmarks/render.py --robot so101 --task stack --sizes 224x224

The output has process CPU time, since machines are shared, as medians over rounds, and ratios to TinyRenderer.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import RenderError
from demorec.core.geometry import Array, Pose
from demorec.core.tables import RENDERERS
from demorec.episode.scene import SceneCamera
from demorec.loop import PreparedEpisode, ScriptAgent, Session, make_world, prepare
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.sim.world import World

SIZES = ((96, 96), (224, 224), (640, 480))


@dataclass(frozen=True)
class State:
    """Arguments of `World.set_state` that show one frame again."""

    joint_position: Array
    object_poses: dict[str, Pose]


@dataclass(frozen=True)
class Variant:
    """One way to draw: renderer, antialiasing, and whether depth and segmentation are drawn too."""

    renderer: str
    antialias: bool
    everything: bool

    @property
    def label(self) -> str:
        smooth = {True: " antialiased", False: " plain"}[self.antialias] if self.renderer == "raster" else ""
        return f"{self.renderer}{smooth}, {'colour + depth + segmentation' if self.everything else 'colour'}"


def plan(index: int = 0, **config: Any) -> PreparedEpisode:
    return prepare(EpisodePlan(config=GenerateConfig(**config), episode_index=index))


def run_episode(world: World, episode: PreparedEpisode) -> list[State]:
    """Every frame of an episode, without images."""
    return [
        State(frame.observation.joint_position, dict(frame.observation.object_poses))
        for frame in Session.of_episode(world, episode).run(ScriptAgent(episode))
    ]


def painter_for(
    renderer: Renderer, world: World, cameras: tuple[SceneCamera, ...], *, antialias: bool, everything: bool
) -> Painter:
    painter = Painter(renderer, cameras, depth=everything, segmentation=everything, antialias=antialias)
    painter.setup(world)
    return painter


def measure(painter: Painter, world: World, states: list[State]) -> float:
    """CPU milliseconds an image over the states; placing the robot is not counted."""
    spent = 0.0
    for state in states:
        world.set_state(joint_position=state.joint_position, object_poses=state.object_poses)
        start = time.process_time()
        painter.images()
        spent += time.process_time() - start
    return 1e3 * spent / len(states)


def table(
    episode: PreparedEpisode, renderers: list[str], sizes: list[tuple[int, int]], rounds: int, frames: int
) -> None:
    variants = [
        Variant(name, antialias, everything)
        for name in renderers
        for antialias in ((True, False) if name == "raster" else (True,))
        for everything in (False, True)
    ]
    with make_world(episode.info) as world:
        states = run_episode(world, episode)
        print(
            f"{len(states)} frames of {episode.info.simulated.task} by {episode.info.robot_name}; {rounds} rounds of "
            f"{frames}"
        )
        for width, height in sizes:
            every = [replace(camera, width=width, height=height) for camera in episode.info.simulated.scene.cameras]
            for cameras in [(camera,) for camera in every] + [tuple(every)]:
                times: dict[Variant, list[float]] = {variant: [] for variant in variants}
                for number in range(rounds):
                    # Use neighbouring frames, as in an episode, and different ones in each round.
                    first = number * max(1, (len(states) - frames) // max(1, rounds - 1)) if rounds > 1 else 0
                    chosen = states[first : first + frames]
                    for variant in variants:
                        with RENDERERS.load(variant.renderer)() as renderer:
                            painter = painter_for(
                                renderer, world, cameras, antialias=variant.antialias, everything=variant.everything
                            )
                            measure(painter, world, chosen[:1])  # fixed cost of a scene
                            few = chosen if variant.renderer == "raster" else chosen[:: max(1, frames // 4)]
                            times[variant].append(measure(painter, world, few) / len(cameras))
                name = " + ".join(camera.name for camera in cameras)
                print(f"\n{width}x{height} {name}: CPU ms an image (times faster than tiny)")
                for variant in variants:
                    middle = statistics.median(times[variant])
                    base = times.get(Variant("tiny", True, variant.everything))
                    ratio = f"{statistics.median(base) / middle:6.1f}x" if base else ""
                    print(f"  {variant.label:50s} {middle:8.2f} {ratio}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renderers", nargs="+", default=list(RENDERERS.names()), choices=RENDERERS.names())
    parser.add_argument("--robot", default="panda", help="task of the measured episode")
    parser.add_argument("--task", default="pick_place", help="which")
    parser.add_argument("--sizes", nargs="+", default=[f"{w}x{h}" for w, h in SIZES])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=16, help="frames a round; a quarter of them for slow renderers")
    options = parser.parse_args()
    sizes = [(int(w), int(h)) for w, _, h in (size.partition("x") for size in options.sizes)]
    renderers = []
    for name in options.renderers:
        try:
            RENDERERS.load(name)().close()
        except RenderError as error:
            print(f"{name} is left out: {error}")
            continue
        renderers.append(name)
    episode = plan(width=96, height=96, robot=options.robot, task=options.task)
    table(episode, renderers, sizes, options.rounds, options.frames)


if __name__ == "__main__":
    main()

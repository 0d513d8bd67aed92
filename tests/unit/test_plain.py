"""Plain data keeps every bit and refuses what it does not know."""

from __future__ import annotations

import pytest

from demorec.core.geometry import Pose, look_at
from demorec.core.plain import from_json, from_plain, to_json, to_plain
from demorec.episode.scene import (
    CONTACT_BREAKING_THRESHOLD,
    FINGER_STIFFNESS,
    Body,
    Physics,
    RobotPlacement,
    Scene,
    SceneCamera,
    Shape,
    Texture,
)


def _scene() -> Scene:
    return Scene(
        robot=RobotPlacement(name="panda", world_from_base=Pose(), joint_position=(0.1, 1 / 3), gripper_width=0.08),
        bodies=(
            Body(
                name="cube",
                role="object",
                shape=Shape(kind="box", size=(0.04, 0.04, 0.04)),
                world_from_body=Pose.from_yaw([0.1, 0.2, 0.3], 1.0),
                mass=0.1,
                texture=Texture(pattern="wood", colors=((0, 0, 0), (1, 1, 1))),
            ),
        ),
        cameras=(
            SceneCamera(
                name="front",
                width=64,
                height=48,
                fov_y=1.0,
                mount="world",
                mount_from_camera=look_at([1, 0, 1], [0, 0, 0]),
            ),
        ),
    )


def test_a_scene_survives_json_to_the_bit() -> None:
    scene = _scene()
    again = from_json(to_json(scene), Scene)
    assert again == scene
    assert again.bodies[0].world_from_body.quat_xyzw.tobytes() == scene.bodies[0].world_from_body.quat_xyzw.tobytes()


def test_unknown_keys_are_named_with_their_place() -> None:
    text = to_json(_scene()).replace('"mass"', '"mas"')
    with pytest.raises(ValueError, match=r"extra fields found \(mas\).*bodies\[0\]"):
        from_json(text, Scene)


@pytest.mark.parametrize(
    ("name", "before", "now"),
    [
        ("contact_breaking_threshold", 0.02, CONTACT_BREAKING_THRESHOLD),
        ("finger_stiffness", 30_000.0, FINGER_STIFFNESS),
    ],
)
def test_physics_says_of_contacts_only_what_is_not_that_of_older_recordings(
    name: str, before: float, now: float
) -> None:
    """Recordings from before a field keep their digests, and are simulated as they were."""
    assert name not in to_plain(Physics())
    assert getattr(from_plain(to_plain(Physics()), Physics), name) == before != now
    new = from_plain(to_plain(Physics()) | {name: now}, Physics)
    assert getattr(new, name) == now
    assert to_plain(new)[name] == now

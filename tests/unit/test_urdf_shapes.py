"""Shapes, colours and masses of a URDF's links; the order in which PyBullet numbers them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from demorec.robots.urdf import Urdf, read_links

TEXT = """
<robot name="thing">
  <material name="blue"><color rgba="0 0 1 0.5"/></material>
  <link name="root">
    <inertial><origin xyz="0 0 0.1"/><mass value="1"/></inertial>
    <visual><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><geometry><box size="1 2 3"/></geometry>
      <material name="blue"/></visual>
    <visual><geometry><mesh filename="a.obj" scale="2 3 4"/></geometry>
      <material name="own"><color rgba="1 0 0 1"/></material></visual>
    <visual><geometry><strange/></geometry></visual>
  </link>
  <link name="right"><collision><geometry><cylinder radius="0.5" length="2"/></geometry></collision></link>
  <link name="tip"><visual><geometry><sphere radius="0.25"/></geometry><material name="unknown"/></visual></link>
  <link name="left"/>
  <joint name="a" type="fixed"><parent link="root"/><child link="right"/></joint>
  <joint name="b" type="fixed"><parent link="root"/><child link="left"/></joint>
  <joint name="c" type="fixed"><parent link="right"/><child link="tip"/></joint>
</robot>
"""


def test_shapes_are_read_with_scale_place_and_colour() -> None:
    root, right, tip, left = read_links(TEXT, scale=2.0)
    assert [link.name for link in (root, right, tip, left)] == ["root", "right", "tip", "left"]
    box, mesh = root.visuals
    assert (box.kind, box.size, box.file, box.rgba) == ("box", (2.0, 4.0, 6.0), "", (0.0, 0.0, 1.0, 0.5))
    assert np.array_equal(box.link_from_shape.position, [2.0, 4.0, 6.0])
    assert box.link_from_shape.apply([1.0, 0.0, 0.0]) - box.link_from_shape.position == pytest.approx([0.0, 1.0, 0.0])
    assert (mesh.kind, mesh.size, mesh.file, mesh.rgba) == ("mesh", (4.0, 6.0, 8.0), "a.obj", (1.0, 0.0, 0.0, 1.0))
    assert np.array_equal(root.link_from_inertial.position, [0.0, 0.0, 0.2])
    assert tip.visuals[0].rgba is None
    assert math.isclose(tip.visuals[0].size[0], 0.5)
    assert right.visuals == ()
    assert right.seen == right.collisions
    assert right.collisions[0].size == (1.0, 4.0)
    assert left.seen == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no xml", "no XML"),
        ('<robot><link name="a"><visual><geometry><box/></geometry></visual></link></robot>', "size"),
        ('<robot><link name="a"><visual><geometry><box size="1 x 1"/></geometry></visual></link></robot>', "x"),
    ],
)
def test_what_cannot_be_read_is_named(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_links(text)


def test_links_are_numbered_depth_first() -> None:
    assert [joint.child for joint in Urdf.parse(TEXT).depth_first()] == ["right", "tip", "left"]

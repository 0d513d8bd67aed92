"""Shapes, colours and masses of a URDF's links; the order in which PyBullet numbers them."""

from __future__ import annotations

import pytest

from demorec.robots.urdf import read_links


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

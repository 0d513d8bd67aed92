"""Joint trees: reading terminates for any joints of a URDF, and a path leads from the root to its link."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from demorec.robots.urdf import Urdf

links = st.integers(0, 6).map("link{}".format)


def urdf_text(pairs: list[tuple[str, str]]) -> str:
    """A URDF with a fixed joint for every (parent, child)."""
    names = sorted({name for pair in pairs for name in pair} | {"root"})
    joints = [
        f'<joint name="joint{n}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'
        for n, (parent, child) in enumerate(pairs)
    ]
    return f"<robot name='r'>{''.join(f'<link name="{name}"/>' for name in names)}{''.join(joints)}</robot>"


@given(st.lists(st.tuples(st.one_of(links, st.just("root")), links), max_size=8))
def test_any_joints_are_a_tree_or_refused(pairs: list[tuple[str, str]]) -> None:
    try:
        urdf = Urdf.parse(urdf_text(pairs))
    except ValueError:
        return
    for link in {child for _, child in pairs}:
        path = urdf.path_to(link)
        assert [joint.parent for joint in path] == ["root", *(joint.child for joint in path[:-1])]
        assert path[-1].child == link
    assert len({child for _, child in pairs}) == len(pairs)
    assert set(urdf.link_poses({})) == {"root", *(child for _, child in pairs)}

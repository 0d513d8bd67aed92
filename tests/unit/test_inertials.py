"""The mass of a robot's links comes from its URDF, never from the simulator's defaults."""

from __future__ import annotations

from pathlib import Path

import pytest

from demorec.core.errors import ConfigError
from demorec.core.geometry import Pose
from demorec.robots.model_check import require_masses
from demorec.sim.bodies import load_urdf
from demorec.sim.client import connect

BOX = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'


def inertial(mass: str = "2", moments: tuple[str, str, str] = ("0.01", "0.01", "0.01"), xy: str = "0") -> str:
    xx, yy, zz = moments
    return (
        f'<inertial><origin xyz="0.5 0 0"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="{xy}" ixz="0" iyz="0"/></inertial>'
    )


def arm(*, arm: str = BOX + inertial(), tool: str = "", base: str = "", ground: str = "") -> str:
    """A root with a fixed child, an arm that turns on the root, and a tool that is fixed to the arm."""
    return f"""<robot name="r">
      <link name="base">{base}</link><link name="ground">{ground}</link><link name="arm">{arm}</link>
      <link name="tool">{tool}</link>
      <joint name="g" type="fixed"><parent link="base"/><child link="ground"/></joint>
      <joint name="turn" type="revolute"><parent link="ground"/><child link="arm"/><axis xyz="0 1 0"/>
        <limit lower="-3" upper="3" effort="100" velocity="10"/></joint>
      <joint name="t" type="fixed"><parent link="arm"/><child link="tool"/><origin xyz="1 0 0"/></joint>
    </robot>"""


@pytest.mark.parametrize(
    "text",
    [
        arm(),
        arm(base=BOX, ground=BOX),  # the mass of fixed bodies does not matter
        arm(base=BOX + inertial(mass="0"), ground=BOX + inertial(mass="0")),  # as in kuka_iiwa/model.urdf
        arm(tool=inertial(mass="0")),  # as in franka_panda/panda.urdf
        arm(arm="", tool=BOX + inertial()),  # one body of two links
        arm(tool=BOX + inertial(mass="1e-9", moments=("0", "0", "0"))),  # as in SO-101's own URDF
    ],
)
def test_frames_and_fixed_bodies_need_no_mass(text: str) -> None:
    require_masses(text)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (arm(arm=BOX), r"'arm' \(moves and has a shape, but no <inertial>\)"),
        (arm(arm=inertial(mass="0")), r"'arm' \(moves, but has no mass\)"),
        (arm(arm=inertial(mass="-1")), r"'arm' \(a mass of -1 kg\)"),
        (arm(arm=inertial(mass="nan")), r"'arm' \('nan' of the URDF should be a finite number\)"),
        (arm(arm=inertial(mass="20000")), r"'arm' \(a mass of 20000 kg\)"),
        (arm(arm='<inertial><mass value="1"/></inertial>'), "without mass or inertia"),
        (arm(arm=inertial(xy="0.02")), "smallest principal value of -0.01 kg"),
        (
            arm(arm=inertial(moments=("5000", "5000", "5000"))),
            r"principal inertias of 5e\+03 to 5e\+03 kg m\^2 for 2 kg",
        ),
        (arm(arm=BOX, tool=BOX), "'arm' .*, 'tool' "),
        (arm(tool=BOX + inertial(moments=("0.01", "-0.01", "0.01"))), "'tool' .*smallest principal value of -0.01"),
    ],
)
def test_a_physically_impossible_link_is_named(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=r"lacks the masses of these links: .*" + sentence):
        require_masses(text)


def test_a_frame_weighs_nothing_and_the_engine_prints_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A static test: the motor holds the arm of 2 kg, half a metre out, and not the frame a metre out."""
    file = tmp_path / "arm.urdf"
    monkeypatch.setattr("demorec.robots.model_check.asset_path", lambda name: file)
    monkeypatch.setattr("demorec.sim.bodies.asset_path", lambda name: file)
    file.write_text(arm())
    client = connect()
    client.setGravity(0, 0, -9.81)
    body = load_urdf(client, "arm.urdf", Pose(), scale=1.0, is_fixed=True, what="robot", is_robot=True)
    client.setJointMotorControl2(body, 1, client.POSITION_CONTROL, targetPosition=0, force=100)
    for _ in range(200):
        client.stepSimulation()
    assert [client.getDynamicsInfo(body, link)[0] for link in range(-1, 3)] == [0, 0, 2, 0]
    assert abs(client.getJointState(body, 1)[3]) == pytest.approx(2 * 9.81 * 0.5, rel=1e-3)
    file.write_text(arm(arm=BOX))
    with pytest.raises(ConfigError, match="The robot cannot be simulated, since its URDF lacks the masses"):
        load_urdf(client, "arm.urdf", Pose(), scale=1.0, is_fixed=True, what="robot", is_robot=True)
    load_urdf(client, "arm.urdf", Pose(), scale=1.0, is_fixed=True, what="body")
    client.disconnect()
    assert capfd.readouterr() == ("", "")

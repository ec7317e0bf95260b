"""Robots of MJCF against MuJoCo itself: what is read, and what is refused."""

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from tests.support.mujoco_oracle import largest_difference
from tests.support.refusals import refused
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.viewing.visuals import link_shapes
from tpgmm_torch.exceptions import DataError, DependencyError, UnknownNameError
from tpgmm_torch.persistence import decode, encode
from tpgmm_torch.robots.mjcf import mjcf_to_urdf
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import parse_xml, read_urdf

ARM = """<mujocoinclude>
  <body name="shoulder" pos="0.1 -0.2 0.3" euler="10 20 30" childclass="arm">
    <joint name="pan" axis="0 0 1"/>
    <joint name="tilt" axis="1 2 0" pos="0.01 0.02 0.03" ref="15" range="-40 100"/>
    <geom class="shown"/>
    <frame pos="0 0 0.2" euler="0 90 0">
      <body name="forearm" quat="0.5 0.5 -0.5 0.5">
        <joint name="extend" class="rail"/>
        <geom class="shown" type="capsule" rgba="1 0 0 1"/>
        <site name="forearm" pos="0 0 0.05"/>
        <body pos="0 0.05 0.1">
          <joint axis="0 1 0" pos="0 0 0.02" limited="false"/>
          <geom class="collision"/>
          <site name="tip" pos="0.02 0 0" quat="0.8 0 0.6 0"/>
          <body name="left_finger" pos="0 0.01 0">
            <joint name="left" class="rail"/><geom/>
          </body>
          <body name="right_finger" pos="0 -0.01 0">
            <joint name="right" class="rail" ref="0.005"/><geom/>
          </body>
        </body>
      </body>
    </frame>
  </body>
</mujocoinclude>"""
SCENE = """<mujoco model="bench">
  <compiler angle="degree" autolimits="true"/>
  <default>
    <geom size="0.02 0.03 0.04" type="box"/>
    <default class="arm">
      <joint range="-90 90"/>
      <default class="rail"><joint type="slide" axis="0 1 1" range="0 0.2"/></default>
      <default class="shown"><geom group="2" rgba="0.2 0.4 0.6 1"/></default>
      <default class="collision"><geom group="3"/></default>
    </default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <include file="arm.xml"/>
    <body name="cup" pos="0.5 0 0"><freejoint name="loose"/><geom/><site name="rim"/></body>
    <body name="target" mocap="true"><site name="goal"/></body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0.002 -0.5 0 0 0"/></equality>
  <actuator>
    <position name="p" joint="pan" ctrlrange="-2 0.5" kp="10" gear="2"/>
    <velocity name="v" joint="tilt" ctrlrange="-1 3" kv="5"/>
    <intvelocity name="i" joint="extend" kp="4" ctrlrange="-0.1 0.1" actrange="0.05 0.3"/>
    <motor name="m" joint="left" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def one(inside: str, around: str = "") -> str:
    return (
        f'<mujoco><worldbody><body name="b">{inside}<geom size="0.1"/></body></worldbody>'
        f"{around}</mujoco>"
    )


class TestAgainstMuJoCo:
    def test_poses_and_jacobians_are_its_own(self, scene: Path) -> None:
        model = mujoco.MjModel.from_xml_path(str(scene))
        urdf = mjcf_to_urdf(scene)
        assert largest_difference(model, urdf, "world", 50) < 1e-13
        assert largest_difference(model, urdf, "forearm", 20) < 1e-13

    @pytest.mark.parametrize(("package", "path", "base"), [
        ("gym_aloha", "assets/bimanual_viperx_transfer_cube.xml", "world"),
        ("dm_control", "suite/humanoid_CMU.xml", "root"),
        ("dm_control", "suite/manipulator.xml", "world"),
        ("dm_control", "third_party/kinova/jaco_arm.xml", "world"),
        ("gymnasium", "envs/mujoco/assets/humanoid.xml", "torso"),
        ("gymnasium", "envs/mujoco/assets/pusher_v5.xml", "world"),
    ])  # fmt: skip
    def test_models_of_other_packages_agree(self, package: str, path: str, base: str) -> None:
        found = importlib.util.find_spec(package)
        if found is None or found.origin is None:
            pytest.skip(f"{package} is not installed")
        file = Path(found.origin).parent / path
        model = mujoco.MjModel.from_xml_path(str(file))
        assert largest_difference(model, mjcf_to_urdf(file), base, 5) < 1e-10


class TestNames:
    def test_bodies_sites_and_joints_keep_theirs(self, scene: Path) -> None:
        robot = Robot.from_mjcf(scene, ["shoulder", "forearm", "forearm_site", "tip"])
        assert robot.joint_names == ("pan", "tilt", "extend", "joint3", "left")
        assert read_urdf(mjcf_to_urdf(scene)).name == "bench"

    def test_nobody_needs_mujoco_to_load_one(self, scene: Path, monkeypatch) -> None:
        robot = Robot.from_mjcf(scene, ["tip"])
        saved = encode(robot)
        monkeypatch.setitem(sys.modules, "mujoco", None)
        assert decode(saved) == robot
        with pytest.raises(DependencyError, match=r"pip install 'tpgmm-torch\[simulation\]'"):
            Robot.from_mjcf(scene, ["tip"])


class TestLimits:
    def test_joints_range_over_what_they_and_their_servos_allow(self, scene: Path) -> None:
        robot = Robot.from_mjcf(scene, ["tip", "left_finger"])
        limits = torch.stack((robot.lower, robot.upper, robot.velocity), -1).numpy()
        inf = np.inf
        expected = [
            [-1, 0.25, inf],  # a position servo of gear 2
            [-np.deg2rad(40), np.deg2rad(100), 3],  # a velocity servo
            [0.05, 0.2, 0.1],  # a servo of integrated velocity
            [-inf, inf, inf],
            [0, 0.014, inf],  # a motor says nothing; there its follower is at an end
        ]
        np.testing.assert_allclose(limits, expected, atol=1e-15)

    def test_servos_in_another_unit_than_the_joint_leave_its_range(self) -> None:
        servo = '<actuator><position joint="j" ctrlrange="100 255"/></actuator>'
        joint = '<joint name="j" range="-1 1" limited="true"/>'
        robot = Robot.from_mjcf(one(joint, servo).replace("<mujoco>", RADIANS), ["b"])
        assert (robot.lower.item(), robot.upper.item()) == (-1, 1)

    def test_followers_follow(self, scene: Path) -> None:
        mimic = read_urdf(mjcf_to_urdf(scene)).joint["right"].mimic
        assert mimic is not None
        assert (mimic.joint, mimic.multiplier) == ("left", -0.5)
        assert mimic.offset == pytest.approx(0.007)

    @pytest.mark.parametrize("equality", ['polycoef="0 1 0.5 0 0"', 'active="false"'])
    def test_joints_that_are_not_tied_by_a_line_move_freely(self, equality: str) -> None:
        joints = '<joint name="j"/><joint name="k" axis="1 0 0"/>'
        tie = f'<equality><joint joint1="j" joint2="k" {equality}/></equality>'
        assert Robot.from_mjcf(one(joints, tie), ["b"]).joint_names == ("j", "k")


RADIANS = '<mujoco><compiler angle="radian"/>'


class TestLooks:
    def test_shown_geoms_become_shapes(self, scene: Path) -> None:
        shapes = link_shapes(read_urdf(mjcf_to_urdf(scene)))
        assert [s.kind for s in shapes["forearm"]] == ["cylinder", "sphere", "sphere"]
        assert shapes["forearm"][0].color == (255, 0, 0)
        assert shapes["shoulder"][0].size == (0.04, 0.06, 0.08)
        assert shapes["shoulder"][0].color == (51, 102, 153)
        assert "world" not in shapes

    def test_meshes_keep_their_files_and_places(self, tmp_path: Path) -> None:
        corners = [(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)]
        faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
        lines = [f"v {x} {y} {z}" for x, y, z in corners]
        lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
        (tmp_path / "meshes").mkdir()
        (tmp_path / "meshes" / "wedge.obj").write_text("\n".join(lines))
        text = one('<geom type="mesh" mesh="wedge" pos="1 2 3" group="1"/>').replace(
            "<mujoco>",
            '<mujoco><compiler meshdir="meshes"/>'
            '<asset><mesh file="wedge.obj" scale="0.1 0.1 0.1"/></asset>',
        )
        file = tmp_path / "robot.xml"
        file.write_text(text)
        shapes = link_shapes(read_urdf(mjcf_to_urdf(file)), tmp_path / "meshes")["b"]
        [mesh] = [shape for shape in shapes if shape.kind == "mesh"]
        assert mesh.file == tmp_path / "meshes" / "wedge.obj"
        assert mesh.size == (0.1, 0.1, 0.1)
        expected = np.eye(4)
        expected[:3, 3] = 1, 2, 3
        np.testing.assert_allclose(mesh.pose, expected, atol=1e-6)  # meshes are float32


class TestRefusing:
    @pytest.mark.parametrize(
        ("joint", "name"), [("<freejoint/>", "joint0"), ('<joint name="j" type="ball"/>', "j")]
    )
    def test_bases_that_float(self, joint: str, name: str) -> None:
        message = f"joint '{name}' of type 'floating' .* give a base beyond it, base='b'"
        refused(lambda: Robot.from_mjcf(one(joint), ["b"]), DataError, message)
        inner = one(joint + '<body name="c"><joint name="k"/><geom size="0.1"/></body>')
        assert Robot.from_mjcf(inner, ["c"], base="b").joint_names == ("k",)

    def test_things_that_are_moved_from_outside(self, scene: Path) -> None:
        with pytest.raises(DataError, match="'target_mount' of type 'floating'"):
            Robot.from_mjcf(scene, ["goal"])

    def test_what_is_not_there(self, scene: Path) -> None:
        with pytest.raises(UnknownNameError, match=r"link 'nose' .*'forearm_site'"):
            Robot.from_mjcf(scene, ["nose"])
        (scene.parent / "arm.xml").unlink()
        with pytest.raises(DataError, match=r"MuJoCo cannot compile the MJCF: .*arm\.xml"):
            Robot.from_mjcf(scene, ["tip"])
        refused(lambda: Robot.from_mjcf("none.xml", ["tip"]), DataError, "cannot be read")

    def test_urdf_says_what_reads_an_mjcf(self) -> None:
        refused(lambda: Robot.from_urdf("<mujoco/>", ["b"]), DataError, r"Robot\.from_mjcf")


class TestFiles:
    def test_the_outermost_element_tells_the_format(self, scene: Path, tmp_path: Path) -> None:
        urdf = tmp_path / "robot.xml"
        urdf.write_text(upper_body_urdf().replace("<robot", "<!-- <mujoco> --><robot", 1))
        assert parse_xml(urdf.read_text()).tag == "robot"
        assert Robot.from_file(str(scene), ["tip"]) == Robot.from_mjcf(scene, ["tip"])
        assert Robot.from_file(urdf, ["l_hand"]) == Robot.from_urdf(urdf, ["l_hand"])

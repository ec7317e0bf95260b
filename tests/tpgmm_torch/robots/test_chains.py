"""Robots of pytorch_kinematics' chains against the chains themselves."""

from typing import Any

import pytest
import pytorch_kinematics as pk
import torch

from tests.support.robot_zoo import HANDS, random_joints, upper_body
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import quaternions
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.robot import Robot

INERTIA = "".join(f"<i{i}>1</i{i}>" for i in ("xx", "xy", "xz", "yy", "yz", "zz"))
INERTIA = f"<inertial><mass>1</mass><inertia>{INERTIA}</inertia></inertial>"
SDF = f"""<sdf version="1.6"><model name="arm">
<link name="base"><pose>0.1 0 0.2 0 0 0</pose>{INERTIA}</link>
<link name="upper"><pose>0.1 0 0.5 0 0 0.3</pose>{INERTIA}</link>
<link name="hand"><pose>0.4 0 0.5 0 0 0.3</pose>{INERTIA}</link>
<joint name="pan" type="revolute"><parent>base</parent><child>upper</child>
<axis><xyz>0 0 1</xyz><limit><lower>-1</lower><upper>2</upper></limit></axis></joint>
<joint name="reach" type="prismatic"><parent>upper</parent><child>hand</child>
<axis><xyz>1 0 0</xyz><limit><lower>0</lower><upper>0.5</upper></limit></axis></joint>
</model></sdf>"""


def assert_agrees(robot: Robot, chain: Any, atol: float) -> None:
    assert list(robot.joint_names) == chain.get_joint_parameter_names()
    joints = random_joints(robot, 50)
    state, poses = robot.state(joints), chain.forward_kinematics(joints.to(chain.dtype))
    for link in robot.links:
        matrix = poses[link].get_matrix().double()
        exact: dict[str, Any] = {"rtol": 0, "atol": atol}
        torch.testing.assert_close(state.position(link), matrix[:, :3, 3], **exact)
        rotation = quaternions.to_matrix(state.orientation(link))
        torch.testing.assert_close(rotation, matrix[:, :3, :3], **exact)


def float64_chain() -> pk.Chain:
    """A slide in a turned frame, a hinge on it and a tool, in float64 from the start."""
    double: dict[str, Any] = {"dtype": torch.float64}

    def frame(name: str, kind: str, axis: list[float], place: list[float]) -> pk.Frame:
        turn = quaternions.normalize(torch.tensor([0.3, 0.1, -0.7, 0.2], **double))
        offset = pk.Transform3d(pos=torch.tensor(place, **double), rot=turn, **double)
        joint = pk.Joint(f"j_{name}", offset, kind, torch.tensor(axis, **double), **double)
        return pk.Frame(name, pk.Link(name), joint)

    root = frame("base", "fixed", [0, 0, 1], [0.3, 0, 0])
    slide = frame("slide", "prismatic", [1, 2, 2], [0.1, 0.2, 0])
    hinge = frame("hinge", "revolute", [0, 1, 1], [0, 0.2, 0.4])
    root.add_child(slide)
    slide.add_child(hinge)
    hinge.add_child(frame("tip", "fixed", [1, 0, 0], [0, 0, 0.1]))
    return pk.Chain(root, **double)


def test_a_chain_in_float64_keeps_its_digits() -> None:
    chain = float64_chain()
    robot = Robot.from_chain(chain, ["base", "slide", "hinge", "tip"])
    assert robot.lengths == (0,)
    assert_agrees(robot, chain, 1e-14)


def test_a_urdf_read_by_it_is_as_good_as_single_precision(capfd: Any) -> None:
    chain = pk.build_chain_from_urdf(upper_body_urdf().encode())
    robot, exact = Robot.from_chain(chain, HANDS), upper_body()
    assert robot.joint_names == exact.joint_names
    for limit in ("lower", "upper", "velocity"):
        torch.testing.assert_close(getattr(robot, limit), getattr(exact, limit))
    joints = random_joints(exact, 200)
    mine, theirs = exact.state(joints), robot.state(joints)
    for part in ("positions", "jacobians"):
        torch.testing.assert_close(
            getattr(mine, part), getattr(theirs, part), rtol=0, atol=1e-6
        )
    assert_agrees(robot, chain, 1e-5)


def test_sdf_is_read_by_it() -> None:
    chain = pk.build_chain_from_sdf(SDF)
    robot = Robot.from_chain(chain, ["upper", "hand"])
    assert (robot.lower.tolist(), robot.upper.tolist()) == ([-1, 0], [2, 0.5])
    assert_agrees(robot, chain, 1e-6)


def test_settings_are_those_of_urdf() -> None:
    chain = pk.build_chain_from_sdf(SDF)
    robot = Robot.from_chain(chain, ["hand"], base="upper", locked={"pan": 0.2})
    assert robot.joint_names == ("reach",)
    assert Robot.from_config(robot.config()) == robot
    with pytest.raises(UnknownNameError, match=r"link 'nose' .*'base', 'hand'"):
        Robot.from_chain(chain, ["nose"])


def test_other_things_are_no_chains() -> None:
    with pytest.raises(DataError, match=r"expected a pytorch_kinematics\.Chain, got 'arm"):
        Robot.from_chain("arm.sdf", ["hand"])

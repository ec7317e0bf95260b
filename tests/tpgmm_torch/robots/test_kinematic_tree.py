"""The moving part of a description, hung on any base, against pinocchio."""

from typing import Any

import numpy as np

from tests.support.robot_zoo import ZOO, ZOO_JOINTS
from tpgmm_torch.robots.kinematic_tree import Body, reduce
from tpgmm_torch.robots.urdf import placement, read_urdf

COLUMNS = {name: column for column, name in enumerate(ZOO_JOINTS)}


def tree(
    links: Any, base: str = "ground", joints: Any = COLUMNS, **locked: float
) -> tuple[Body, ...]:
    others = dict.fromkeys(set(ZOO_JOINTS) - set(joints), 0.0)
    wanted = [(link, np.eye(4)) for link in links]
    return reduce(read_urdf(ZOO), base, wanted, joints, others | locked)


def test_only_joints_on_the_way_are_kept_and_parents_come_first():
    reduced = tree(("flange", "tail"))
    assert [body.joint for body in reduced] == [None, 0, 1, 2, 4, None, None]
    assert [body.parent for body in reduced] == [0, 0, 1, 2, 0, 3, 4]
    assert [body.slides for body in reduced] == [False, True, *[False] * 5]


def test_what_two_links_share_is_there_once():
    reduced = tree(("l_finger", "r_finger", "flange", "flange"))
    assert [body.parent for body in reduced] == [0, 0, 1, 2, 3, 3, 4, 5, 3, 3]


def test_seen_from_beyond_a_joint_its_axis_is_the_other_way_round():
    (_, down, below), (_, up, above) = tree(("column",)), tree(("ground",), "column")
    origin = read_urdf(ZOO).joint["lift"].origin
    np.testing.assert_allclose(down.pose[:3, 2], origin[:3, 2], atol=1e-15)
    np.testing.assert_allclose(up.pose[:3, 2], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(down.pose @ below.pose, origin, atol=1e-15)
    np.testing.assert_allclose(up.pose @ above.pose @ origin, np.eye(4), atol=1e-15)


def test_the_pose_in_a_link_is_kept_behind_what_is_folded_into_it():
    tool = placement(np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.2, 0.1]))
    weld = placement(np.array([0.2, 0.0, 0.0]), np.array([1.2, 0.4, -0.7]))
    reduced = reduce(read_urdf(ZOO), "arm", [("flange", tool)], COLUMNS, {})
    assert [body.joint for body in reduced] == [None, None]
    np.testing.assert_allclose(reduced[1].pose, weld @ tool, atol=1e-15)

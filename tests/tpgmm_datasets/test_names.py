"""Names of values: as data sets spell them, and as a robot does."""

import pytest

from tests.support.lerobot_sets import NAMES, Arm, assert_equal, change_info, joints_of, to_v21
from tpgmm_datasets import DatasetError, load_lerobot


@pytest.mark.parametrize(
    "names",
    [
        list(NAMES),
        [list(NAMES)],
        [[list(NAMES)]],
        {"motors": list(NAMES)},
        {"gripper": 2, "left_elbow": 0, "right_elbow": 1},
    ],
)
def test_names_are_found_however_they_are_nested(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names == NAMES


@pytest.mark.parametrize(
    "spelling",
    [
        ("right_elbow", "left_elbow"),
        ("right_elbow_joint", "left_elbow_joint"),
        ("kRightElbow", "kLeftElbow"),
        ("r_elbow.pos", "l_elbow.pos"),
        ("RightElbow", "LeftElbow"),
    ],
)
def test_a_robot_gets_its_joints_in_its_order_however_they_are_spelled(root, spelling):
    expected = [joints[:, [1, 0]] for joints in joints_of(load_lerobot(root))]
    found = load_lerobot(root, robot=Arm(*spelling))
    assert_equal(joints_of(found), expected)
    assert found[0].joint_names == spelling


def test_a_robot_joint_that_fits_two_values_is_refused(root):
    options = {"joint_names": ["l_elbow", "left.elbow", "x"], "robot": Arm("left_elbow")}
    with pytest.raises(DatasetError, match="fits several values"):
        load_lerobot(root, **options)

"""Which values are the joints, and what they are called."""

import pytest

from tests.support.lerobot_sets import (
    DATA,
    Arm,
    assert_equal,
    change_info,
    change_table,
    joints_of,
    to_v21,
)
from tpgmm_datasets import DatasetError, load_lerobot


@pytest.mark.parametrize("names", [None, ["state"], [1, 2, 3], ["a", "a", "b"]])
def test_names_that_name_nothing_count_as_missing(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names is None
    assert load_lerobot(plain, joint_names=["x", "y", "z"])[0].joint_names == ("x", "y", "z")
    assert load_lerobot(plain, robot=Arm("a", "b", "c"))[0].joint_names == ("a", "b", "c")
    with pytest.raises(DatasetError, match="name all values"):
        load_lerobot(plain, robot=Arm("a", "b"))


def test_a_mapping_names_the_joints_that_are_called_otherwise(root):
    found = load_lerobot(root, robot=Arm("hand", "left_elbow"), joint_names={"gripper": "hand"})
    expected = [joints[:, [2, 0]] for joints in joints_of(load_lerobot(root))]
    assert_equal(joints_of(found), expected)


def test_the_joint_feature_is_found_or_chosen(root):
    expected = joints_of(load_lerobot(root))
    action = joints_of(load_lerobot(root, joints="action"))
    assert_equal([a[:-1] for a in action], [e[1:] for e in expected])
    assert_equal(joints_of(load_lerobot(root, joints="commanded")), action)
    assert_equal(joints_of(load_lerobot(root, joints="measured")), expected)
    rename = {"observation.state": "state"}
    change_table(
        root, DATA, lambda t: t.rename_columns([rename.get(n, n) for n in t.column_names])
    )
    change_info(
        root, lambda i: i["features"].update(state=i["features"].pop("observation.state"))
    )
    assert_equal(joints_of(load_lerobot(root)), expected)


def test_commanded_joints_need_actions(root):
    change_info(root, lambda info: info["features"].pop("action"))
    with pytest.raises(DatasetError, match=r"there are no commanded joints.*--joints"):
        load_lerobot(root, joints="commanded")

"""Which values are the joints, and what they are called."""

import pytest
import torch

from tests.support.lerobot_sets import (
    DATA,
    Arm,
    assert_equal,
    change_info,
    change_table,
    joints_of,
    to_v21,
)
from tpgmm_datasets import DatasetError, DatasetWarning, load_lerobot
from tpgmm_torch.exceptions import PlausibilityWarning


@pytest.mark.parametrize("names", [None, [], {}, ["state"]])
def test_a_set_without_names_has_the_robots_only_if_somebody_says_so(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names is None
    assert load_lerobot(plain, joint_names=["x", "y", "z"])[0].joint_names == ("x", "y", "z")
    robot = Arm("a", "b", "c")
    with pytest.raises(DatasetError, match=r"does not name its 3 values.*--joint-name robot"):
        load_lerobot(plain, robot=robot)
    assert load_lerobot(plain, robot=robot, joint_names="robot")[0].joint_names == tuple("abc")
    with pytest.raises(DatasetError, match="3 different names, got 2"):
        load_lerobot(plain, robot=Arm("a", "b"), joint_names="robot")
    with pytest.raises(DatasetError, match="needs a robot"):
        load_lerobot(plain, joint_names="robot")


def test_a_mapping_names_the_joints_that_are_called_otherwise(root):
    found = load_lerobot(root, robot=Arm("hand", "left_elbow"), joint_names={"gripper": "hand"})
    expected = [joints[:, [2, 0]] for joints in joints_of(load_lerobot(root))]
    assert_equal(joints_of(found), expected)


def rename_state(root, name):
    """The measured joints under another name."""

    def rename(table):
        given = table.column_names
        return table.rename_columns([name if n == "observation.state" else n for n in given])

    def move(info):
        info["features"][name] = info["features"].pop("observation.state")

    change_table(root, DATA, rename)
    change_info(root, move)


def test_the_joint_feature_is_found_or_chosen(root):
    expected = joints_of(load_lerobot(root))
    action = joints_of(load_lerobot(root, joints="action"))
    # an action is the next state, and the last is that of the end
    assert_equal(action, [torch.cat((e[1:], e[-1:])) for e in expected])
    assert_equal(joints_of(load_lerobot(root, joints="measured")), expected)
    with pytest.warns(DatasetWarning, match="commands are learned beside") as caught:
        assert_equal(joints_of(load_lerobot(root, joints="commanded")), expected)
    assert len(caught) == 1
    rename_state(root, "state")
    assert_equal(joints_of(load_lerobot(root)), expected)


@pytest.mark.parametrize("name", ["observation.states.joint.position", "measured", "arm.qpos"])
def test_commands_in_place_of_an_unusual_state_are_told_once(root, name):
    rename_state(root, name)
    with pytest.warns(
        PlausibilityWarning, match=f"commands.*{name}.*joints='{name}'"
    ) as caught:
        commands = joints_of(load_lerobot(root))
    assert len(caught) == 1
    assert_equal(joints_of(load_lerobot(root, joints="commanded")), commands)
    measured = joints_of(load_lerobot(root, joints=name))
    assert_equal([m[1:] for m in measured], [c[:-1] for c in commands])


def test_a_set_without_joints_is_refused(root):
    for name in ("action", "observation.state"):
        change_info(root, lambda info, name=name: info["features"].pop(name))
    for word in (None, "measured", "commanded"):
        with pytest.raises(DatasetError, match=r"there are no joints.*--joints"):
            load_lerobot(root, joints=word)

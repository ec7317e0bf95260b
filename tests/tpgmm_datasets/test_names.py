"""Names of values: as data sets spell them, and as a robot does."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.lerobot_sets import NAMES, Arm, assert_equal, change_info, joints_of, to_v21
from tpgmm_datasets import DatasetError, describe_lerobot, load_lerobot
from tpgmm_datasets.names import value_names


@pytest.mark.parametrize(
    "names",
    [
        list(NAMES),
        [list(NAMES)],
        [[list(NAMES)]],
        {"motors": list(NAMES)},
        {"gripper": 2, "left_elbow": 0, "right_elbow": 1},
        {"gripper": 3, "left_elbow": 1, "right_elbow": 2},
        [["left_elbow", "right_elbow"], ["gripper"]],
        {"left": ["elbow"], "right": ["elbow"], "hand": ["gripper"]},
        {"arms": {"left": ["left_elbow"], "right": ["right_elbow"]}, "hand": ["gripper"]},
    ],
)
def test_names_are_found_however_they_are_nested(root, tmp_path, names):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    assert load_lerobot(plain)[0].joint_names == NAMES


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a", "b"], "2 names for 3 values"),
        (["a", "b", "c", "d"], "4 names for 3 values"),
        (["a", "gripper", "gripper"], "'gripper' is there twice"),
        ({"left": ["a", "a"], "right": ["a"]}, "'a' is there twice|'a' and 'a' is there twice"),
        ([1, 2, 3], "1 is no name"),
        (["a", None, "c"], "None is no name"),
        (["a", "b", " "], "' ' is no name"),
        ({"a": 0, "b": 1, "c": 1}, r"positions of the names, \[0, 1, 1\]"),
        ({"a": 0, "b": 2, "c": 4}, r"positions of the names, \[0, 2, 4\]"),
        ({"a": "rad", "b": "rad", "c": "rad"}, "positions of the names"),
        ("abc", "1 names for 3 values"),
    ],
)
def test_names_that_cannot_be_used_are_an_error_that_says_why(root, tmp_path, names, message):
    plain = to_v21(root, tmp_path / "plain")
    change_info(plain, lambda i: i["features"]["observation.state"].update(names=names))
    remedy = r"joint_names=.*--joint-name NAME.*joint_names='robot'"
    for options in {}, {"robot": Arm("a", "b", "c")}, {"joint_names": {"a": "b"}}:
        with pytest.raises(DatasetError, match=f"({message}).*{remedy}"):
            load_lerobot(plain, **options)
    [problem] = describe_lerobot(plain).problems
    assert re.search(message, str(problem)) and problem.check == "joints"
    for order in ["x", "y", "z"], "robot":
        found = load_lerobot(plain, robot=Arm("x", "y", "z"), joint_names=order)
        assert found[0].joint_names == ("x", "y", "z")
        assert_equal(joints_of(found), joints_of(load_lerobot(root)))


@given(st.data())
def test_no_name_is_lost_in_groups(data):
    """Each value is called by its name, and by its group's where two groups have that name."""
    words = st.sampled_from("abcde")
    groups = data.draw(st.dictionaries(words, st.lists(words, max_size=3, unique=True)))
    flat = [(group, name) for group, names in groups.items() for name in names]
    found, wrong = value_names(groups, len(flat))
    assert wrong == "" and len(found or ()) == len(flat)
    bare = [name for _, name in flat]
    expected = [f"{g}_{n}" if bare.count(n) > 1 else n for g, n in flat]
    assert list(found or ()) == expected
    for width in (len(flat) - 1, len(flat) + 1):
        if len(flat) > 1:
            assert value_names(groups, width)[0] is None and value_names(groups, width)[1]


def test_names_are_read_to_any_depth_but_that_of_the_whole_feature():
    names = ["a"]
    for _ in range(10_000):
        names = [names]
    assert value_names(names, 1) == (("a",), "")
    assert value_names(["state"], 3, "observation.state") == (None, "")
    assert value_names(["state"], 1, "observation.state") == (("state",), "")
    assert value_names(["arm"], 3, "observation.state")[1] == "1 names for 3 values, ['arm']"


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

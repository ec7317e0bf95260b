"""Orders, names and units of states and actions; where the pose of an object comes from."""

import pytest
import torch

from lerobot_policy_tpgmm.observations import FrameFeatures, JointFeatures
from tests.support.policies import ENVIRONMENT, STATE, act, batch, changed, fitted, policy
from tests.support.skills import JOINT_NAMES
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

NAMES = fitted().kinematics.joint_names
POSE_NAMES = [f"bottle_{part}.pos" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
REVERSED = [f"{name}.pos" for name in NAMES[::-1]]
POSE = [0.3, -0.1, 0.2, 1.0, 0.0, 0.0, 0.0]


def features(units=None, state=JOINT_NAMES, action=JOINT_NAMES) -> JointFeatures:
    return JointFeatures(JOINT_NAMES, state, action, units)


# Joints


def test_joints_are_found_by_name_in_any_order_and_spelling():
    made = features(state=("c.pos", "more", "a.pos", "b_joint"), action=("b", "c.pos", "a"))
    joints = made.joints(torch.tensor([[3.0, 9.0, 1.0, 2.0]]))
    assert joints.tolist() == [[1.0, 2.0, 3.0]]
    action = made.action(joints)
    assert action.tolist() == [[2.0, 3.0, 1.0]] and action.dtype == torch.float32
    assert made.decode_action(action).tolist() == joints.tolist()


def test_units_are_converted_both_ways():
    units = {"a": "deg", "b.pos": [0.015, 0.1], "c": "mm"}
    made = features(units, state=("c", "b.pos", "a"), action=("a", "b.pos", "c"))
    joints = made.joints(torch.tensor([[250.0, 20.0, 90.0]], dtype=torch.float64))
    torch.testing.assert_close(joints, torch.tensor([[torch.pi / 2, 0.4, 0.25]]).double())
    torch.testing.assert_close(made.action(joints), torch.tensor([[90.0, 20.0, 250.0]]))
    torch.testing.assert_close(made.decode_action(made.action(joints)), joints)
    patterns = features({"*": "deg", "b*": "raw"})
    assert patterns.raw == {"b"}
    assert patterns.scale[:, 0].tolist() == [torch.pi / 180, 1, torch.pi / 180]
    assert features("deg").action(torch.tensor([[torch.pi] * 3])).tolist() == [[180.0] * 3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": ("a", "b")}, "observation.state.*'c' is not among the values.*state_names="),
        ({"state": ("a", "b")}, r"--policy\.joints='left_\*,right_\*'"),
        ({"action": ("a", "b")}, "action.*'c' is not among.*another robot or data set"),
        ({"action": ("a", "b", "c", "gripper")}, r"\['gripper'\], which are no joints"),
        ({"state": ("a", "b", "c", "c_joint")}, None),
        ({"state": ("a", "b", "c.pos", "c_joint")}, "'c' fits several values"),
        ({"units": "turns"}, "unit 'turns' is unknown"),
        ({"units": {"d": "deg"}}, r"units names \['d'\], .* called \['a', 'b', 'c'\]"),
        ({"units": {"a": [1.0]}}, r"\[factor, offset\], got \[1.0\]"),
        ({"units": {"a": [0.0, 1.0]}}, r"\[factor, offset\]"),
    ],
)
def test_what_does_not_fit_is_refused(options, message):
    if message is None:
        features(**options)
        return
    with pytest.raises(DataError, match=message):
        features(**options)


def test_a_state_of_another_size_is_refused():
    message = r"shape \(batch, 3\) for \['a', 'b', 'c'\], got \(2, 4\)"
    with pytest.raises(ShapeError, match=message):
        features().joints(torch.zeros(2, 4))
    with pytest.raises(DataError, match=r"needs observation.state; the batch has"):
        act(fitted(), {ENVIRONMENT: batch()[ENVIRONMENT]}, 1)


def test_a_robot_of_reversed_order_in_degrees_does_the_same():
    wanted = act(fitted(), batch(), 10)
    other = changed(fitted(), state_names=REVERSED, action_names=REVERSED, units="deg")
    observed = {**batch(), STATE: batch()[STATE].flip(-1).rad2deg()}
    actions = act(other, observed, 10)
    torch.testing.assert_close(actions.flip(-1).deg2rad(), wanted, rtol=0, atol=1e-5)


# Frames


def test_a_pose_is_taken_from_the_state_if_the_robot_observes_it():
    wanted = act(fitted(), batch(), 5)
    for names in ([*NAMES, *POSE_NAMES], [*POSE_NAMES, *NAMES]):
        other = changed(fitted(), state_names=names)
        parts = [batch()[STATE], batch()[ENVIRONMENT]]
        if names[0] == POSE_NAMES[0]:
            parts.reverse()
        assert torch.equal(act(other, {STATE: torch.cat(parts, dim=-1)}, 5), wanted)
        both = {STATE: torch.cat(parts, dim=-1), ENVIRONMENT: batch()[ENVIRONMENT] + 0.0}
        assert torch.equal(act(other, both, 5), wanted)


def test_a_pose_may_have_a_default():
    pose = batch()[ENVIRONMENT][0].tolist()
    alone = {STATE: batch()[STATE][:1]}
    other = changed(fitted(), default_environment_state=pose)
    assert torch.equal(act(other, alone, 5), act(fitted(), batch(), 5)[:1])
    # what is observed comes first
    assert torch.equal(act(other, batch(), 5), act(fitted(), batch(), 5))


def test_what_is_no_pose_is_refused():
    for width, error, message in (
        (14, ShapeError, r"shape \(2, 7\), got \(2, 14\): is this policy for"),
        (7, DataError, r"frame 'bottle': .*unit quaternion"),
    ):
        with pytest.raises(error, match=message):
            act(fitted(), {**batch(), ENVIRONMENT: torch.zeros(2, width)}, 1)
    with pytest.raises(ShapeError, match="default_environment_state has 6 values"):
        changed(fitted(), default_environment_state=POSE[:6])


def frames(**options) -> FrameFeatures:
    given = {"places": None, "environment_names": None, "state_names": (), "default": None}
    return FrameFeatures(("cup", "plate"), **{**given, **options})


def test_places_of_frames():
    assert frames().in_environment == {"cup": [*range(7)], "plate": [*range(7, 14)]}
    parts = ("qw", "qx", "qy", "qz", "x", "y", "z")
    names = [f"{name}.{part}" for name in ("plate", "more", "cup") for part in parts]
    named = frames(environment_names=names)
    assert named.in_environment["cup"] == [18, 19, 20, 14, 15, 16, 17]
    assert named.n_environment == 21
    places = {"cup": [*range(3, 10)], "plate": list("xyzabcd")}
    chosen = frames(places=places, state_names="dcbazyx")
    assert chosen.in_environment == {"cup": [*range(3, 10)]}
    assert chosen.in_state == {"plate": [6, 5, 4, 3, 2, 1, 0]}
    values = torch.arange(10.0)[None].double()
    values[0, 6:10] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    state = torch.tensor([[0.0, 0.0, 0.0, 1.0, 7.0, 8.0, 9.0]])
    found = chosen.frames({ENVIRONMENT: values, STATE: state})
    assert found["cup"].position.tolist() == [[3.0, 4.0, 5.0]]
    assert found["cup"].orientation.tolist() == [[0.0, 1.0, 0.0, 0.0]]
    assert found["plate"].position.tolist() == [[9.0, 8.0, 7.0]]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"places": {"bowl": [*range(7)]}}, UnknownNameError, "'bowl' is not in the model"),
        ({"places": {"cup": [0, 1, 2]}}, DataError, "seven entries, x y z qw qx qy qz; got"),
        ({"places": {"cup": list("abcdefg")}}, DataError, "are not all entries of observation"),
        ({"n_environment": 10}, ShapeError, "has 10 entries, the frames"),
    ],
)
def test_a_place_that_is_none_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        frames(**options)


def test_names_of_the_environment_that_tell_of_no_such_frame_leave_it_missing():
    other = policy(environment_names=[f"cup.{part}" for part in ("x", "y", "z")] + list("abcd"))
    with pytest.raises(DataError, match="pose of 'bottle' is missing"):
        act(other, batch(), 1)

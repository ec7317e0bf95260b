"""What demonstrations are compared by."""

import numpy as np
import pytest
import torch

from tests.support.motions import DEMONSTRATIONS, Arm, turning
from tests.support.refusals import refused
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.alignment.features import AlignmentFeatures, quaternion_columns
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.tracked_poses import Poses


def test_features_are_named_and_constant_ones_left_out():
    transformer = DynamicTimeWarping(0, robot=Arm()).fit(DEMONSTRATIONS[:2])
    assert transformer.feature_names_ == ("speed", "joints", "elbow", "hand")
    with pytest.raises(UnknownNameError, match="'knee' is not in the features; it has"):
        DynamicTimeWarping(features=["knee"]).fit(DEMONSTRATIONS[:2])
    chosen = ["hand in bottle", "joints"]
    transformer = DynamicTimeWarping(0, features=chosen, robot=Arm()).fit(DEMONSTRATIONS[:2])
    assert transformer.feature_names_ == tuple(chosen)
    still = [
        Demonstration(d.time, d.joints * torch.tensor([0.0, 1, 0, 1, 1]), d.frames)
        for d in DEMONSTRATIONS[:2]
    ]
    assert "elbow" not in DynamicTimeWarping(0, robot=Arm()).fit(still).feature_names_


def test_nothing_to_align_by_is_an_error():
    still = Demonstration(np.arange(5.0), np.ones((5, 2)))
    refused(lambda: DynamicTimeWarping().fit([still, still]), DataError, "nothing to align by")


def scale_units(demonstrations, name, robot=None):
    """The columns of one group."""
    features = AlignmentFeatures.fit(demonstrations, robot, [name])
    return [features(one) for one in demonstrations]


def variance(rows):
    """Of the columns along each demonstration, summed; a mean over all time steps."""
    sizes = [len(one) for one in rows]
    return np.average([one.var(axis=0).sum() for one in rows], weights=sizes)


WEIGHTS = {"joints": 1.0, "speed": 5.0, "directions": 4.5, "hand": 1.0, "hand in bottle": 1.0}


@pytest.mark.parametrize("name, weight", WEIGHTS.items())
def test_a_group_has_the_square_of_its_weight_as_variance(name, weight):
    family = DEMONSTRATIONS[:3]
    assert variance(scale_units(family, name, Arm())) == pytest.approx(weight**2)


def test_features_are_what_they_are_called():
    family = DEMONSTRATIONS[:2]
    [joints, _] = scale_units(family, "joints")
    given = family[0].joints.numpy()
    np.testing.assert_allclose(joints / joints[500, 0], given / given[500, 0], rtol=1e-9)
    seen = scale_units(family, "hand in bottle", Arm())[0]
    frame = family[0].frames["bottle"]
    place = frame.inverse_transform(Arm().state(family[0].joints).position("hand")).numpy()
    moved = place.std(axis=0) > 1e-9
    np.testing.assert_allclose(seen / seen[300, 0], place[:, moved] / place[300, moved][0])


def test_directions_do_not_depend_on_the_speed_and_fade_out_at_standstill():
    time = np.linspace(0, 4, 401)
    # forth along (3, 4), a rest, and back at half the speed
    way = np.interp(time, [0, 1, 2, 4], [0, 1, 1, 0])
    direction = scale_units([Demonstration(time, np.outer(way, [3.0, 4.0]))], "directions")[0]
    forth, rest, back = direction[50], direction[150], direction[300]
    np.testing.assert_allclose(forth[1] / forth[0], 4 / 3)
    np.testing.assert_allclose(rest, 0, atol=1e-9)
    np.testing.assert_allclose(back / back[1], forth / forth[1])
    # of speeds 5 and 2.5 after a root mean square over all of them
    speeds = np.array([5.0, 2.5])
    usual = 0.3**2 * np.mean(np.array([5.0, 0, 2.5, 2.5]) ** 2)
    expected = np.divide(*(speeds / np.sqrt(speeds**2 + usual)))
    assert -forth[0] / back[0] == pytest.approx(expected, rel=0.01)


def test_quaternions_are_found_by_the_names_of_the_joints():
    time = np.linspace(0, 1, 30)
    own = turning(time, time)
    poses = Poses(["hand"])
    assert quaternion_columns(own, poses) == [[3, 4, 5, 6]]
    names = own.joint_names
    assert quaternion_columns(own.reorder(names[::-1]), poses) == [[3, 2, 1, 0]]
    plain = Demonstration(own.time, own.joints)
    assert quaternion_columns(plain, poses) == [[3, 4, 5, 6]]
    assert quaternion_columns(plain, None) == quaternion_columns(plain, Arm()) == []
    with pytest.raises(ShapeError, match="has 3 joints without names, the robot has 7"):
        quaternion_columns(Demonstration(time, np.ones((30, 3))), poses)
    with pytest.raises(UnknownNameError, match=r"'hand\.qw' is not in the demonstration"):
        quaternion_columns(own.reorder(names[:3]), poses)


@pytest.mark.parametrize("names, left", [
    (None, ("directions",)),
    (["directions"], ("speed", "joints", "elbow", "hand")),
    (["hand in bottle"], ("speed", "joints", "directions", "elbow", "hand")),
])  # fmt: skip
def test_the_others_are_what_is_not_used(names, left):
    family = DEMONSTRATIONS[:2]
    features = AlignmentFeatures.fit(family, Arm(), names)
    assert features.others(family).names == left
    everything = AlignmentFeatures.fit(family, None, ["joints", "speed", "directions"])
    assert everything.others(family) is None


def test_speeds_are_those_of_links_or_of_the_joints_over_their_own_usual_one():
    time = np.linspace(0, 4, 401)
    way = np.interp(time, [0, 1, 2, 4], [0, 1, 1, 0])  # 1 rad/s, a rest, 0.5 rad/s
    usual = np.sqrt((1 + 0 + 0.25 + 0.25) / 4)
    for scale in (1.0, 100.0):
        moving = Demonstration(time, scale * np.outer(way, [0.6, 0.8]))
        [speed] = scale_units([moving], "speed")
        assert speed.shape == (401, 1)
        speed = speed[:, 0] / np.sqrt((speed**2).mean())
        np.testing.assert_allclose(
            speed[[50, 150, 300]], np.array([1, 0, 0.5]) / usual, atol=0.02
        )
    # the elbow of the arm stands still, and no rounding is blown up
    joints = np.zeros((401, 5))
    joints[:, 4] = way
    names = AlignmentFeatures.fit([Demonstration(time, joints)], Arm(), ["speed", "elbow"])
    assert names.columns["speed"].tolist() == [False, True]

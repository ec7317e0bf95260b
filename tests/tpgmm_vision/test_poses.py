import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.poses import (
    angle_between,
    inverse,
    mean_pose,
    pose_matrix,
    pose_vector,
    rigid,
    transform,
)


def drawn(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([rigid(rng.normal(size=3), rng.normal(size=3)) for _ in range(n)])


def test_values_and_matrices_are_the_same_poses():
    poses = drawn(20)
    np.testing.assert_allclose(pose_matrix(pose_vector(poses)), poses, atol=1e-12)
    np.testing.assert_allclose(
        inverse(poses) @ poses, np.tile(np.eye(4), (20, 1, 1)), atol=1e-12
    )
    assert (pose_vector(poses)[:, 3] >= 0).all()
    points = np.random.default_rng(1).normal(size=(5, 3))
    back = transform(inverse(poses[0]), transform(poses[0], points))
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_the_mean_leaves_out_what_does_not_agree():
    [pose], rng = drawn(1), np.random.default_rng(2)
    near = [pose @ rigid(rng.normal(0, 0.002, 3), rng.normal(0, 0.0003, 3)) for _ in range(9)]
    flipped = pose @ rigid((1.0, 0, 0), (0, 0, 0))
    mean, agree = mean_pose([*near, flipped, pose @ rigid((0, 0, 0), (0.05, 0, 0))])
    assert agree.tolist() == [True] * 9 + [False] * 2
    assert angle_between(mean, pose) < 0.003 and np.abs(mean - pose)[:3, 3].max() < 0.0005
    assert mean_pose([pose])[1].all()


def test_an_angle_is_that_of_the_rotation_between():
    [pose] = drawn(1)
    turned = pose @ rigid(Rotation.from_euler("x", 0.3).as_rotvec(), (1, 2, 3))
    assert angle_between(pose, turned) == pytest.approx(0.3)


@pytest.mark.parametrize("wrong", [[0] * 6, [0, 0, 0, 1, 0, 0, np.nan], [0, 0, 0, 2, 0, 0, 0]])
def test_what_is_no_pose_is_refused(wrong):
    with pytest.raises(DataError):
        pose_matrix(wrong)

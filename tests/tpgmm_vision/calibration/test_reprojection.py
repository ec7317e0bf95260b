"""Expected corners: their Jacobian is that of small steps, for all that can be calibrated."""

import numpy as np

from tests.support.simulated_cells import BI_HANDS, CAMERA, looking, robot_named
from tpgmm_vision.calibration.reprojection import Corners, Reprojection
from tpgmm_vision.poses import rigid


def test_the_jacobian_is_that_of_small_steps():
    rng, robot, n = np.random.default_rng(0), robot_named("bi_so101"), 40
    left, right = BI_HANDS
    corners = Corners(
        np.zeros((n, 2)), rng.normal(0, 0.03, (n, 3)), np.sort(rng.integers(0, 5, n)),
        rng.integers(0, 2, n), rng.integers(0, 3, n), np.zeros(n, int),
    )  # fmt: skip
    problem = Reprojection(
        robot, rng.normal(0, 0.4, (5, robot.n_joints)), corners, [CAMERA, CAMERA],
        [None, left, right, left, None], [{right}],
    )  # fmt: skip
    poses = np.stack([rigid(rng.normal(0, 0.3, 3), rng.normal(0, 0.2, 3)) for _ in range(6)])
    poses[0] = looking((1.5, 0.3, 0.6), (0.2, 0, 0.1))
    poses[1] = rigid(rng.normal(0, 0.3, 3), (0, 0, -1.5))
    state = problem.state(poses)
    _, offsets, scales = problem.split(state)
    offsets[:], scales[:] = rng.normal(0, 0.05, len(offsets)), rng.normal(0, 0.02, 3)
    _, jacobian, _ = problem.expect_pixels(state)
    for column, step in enumerate(1e-6 * np.eye(problem.n_steps)):
        after, before = (
            problem.expect_pixels(problem.move_state(state, sign * step))[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[..., column], (after - before) / 2e-6, atol=1e-4)
    free = problem.free[problem.offsets]
    assert [n for n, moves in zip(robot.joint_names, free, strict=True) if not moves] == [
        "left_gripper", "right_gripper",
    ]  # fmt: skip

"""MuJoCo's own kinematics as an oracle for robots that were read from MJCF."""

from typing import Any

import mujoco
import numpy as np

from tests.support.robot_zoo import random_joints, skew
from tpgmm_torch import quaternions
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import UrdfModel, read_urdf


def largest_difference(model: Any, urdf: str, base: str, postures: int, seed: int = 0) -> float:
    """Between poses and Jacobians of all bodies and sites that a base carries."""
    body_names = [model.body(i).name or f"body{i}" for i in range(model.nbody)]
    joint_names = [model.joint(i).name or f"joint{i}" for i in range(model.njnt)]
    root = body_names.index(base)
    bodies = [i for i in range(model.nbody) if carried(model, i, root)]
    sites = [
        i for i in range(model.nsite) if model.site_bodyid[i] in bodies and model.site(i).name
    ]
    site_names = [model.site(i).name for i in sites]
    links = [body_names[i] for i in bodies]
    links += [f"{name}_site" if name in body_names else name for name in site_names]
    robot = Robot.from_urdf(urdf, links, base=base)
    assert robot.n_joints > 0
    followers, data = read_urdf(urdf), mujoco.MjData(model)
    joints = random_joints(robot, postures, seed=seed)
    state = robot.state(joints)
    turned = quaternions.to_matrix(state.orientations).numpy()
    worst = 0.0
    for row, values in enumerate(joints.numpy()):
        place(data, model, joint_names, followers, dict(zip(robot.joint_names, values)))  # noqa: B905
        R_b, p_b = data.xmat[root].reshape(3, 3), data.xpos[root]
        J_b = jacobian(mujoco.mj_jacBody, model, data, root)
        placed = [("body", i) for i in bodies] + [("site", i) for i in sites]
        for column, (kind, i) in enumerate(placed):
            body = kind == "body"
            p, R = (
                (data.xpos[i], data.xmat[i]) if body else (data.site_xpos[i], data.site_xmat[i])
            )
            J = jacobian(mujoco.mj_jacBody if body else mujoco.mj_jacSite, model, data, i)
            linear = J[:3] - J_b[:3] + skew(p - p_b) @ J_b[3:]
            relative = np.vstack((R_b.T @ linear, R_b.T @ (J[3:] - J_b[3:])))
            expected = np.zeros((6, robot.n_joints))
            for index, name in enumerate(joint_names):
                if name in followers.movable:
                    leader = followers.leader(name)
                    dof = relative[:, model.jnt_dofadr[index]]
                    expected[:, robot.joint_names.index(leader.joint)] += (
                        leader.multiplier * dof
                    )
            for mine, theirs in (
                (state.positions[row, column], R_b.T @ (p - p_b)),
                (turned[row, column], R_b.T @ R.reshape(3, 3)),
                (state.jacobians[row, column], expected),
            ):
                worst = max(worst, float(np.abs(np.asarray(mine) - theirs).max()))
    return worst


def carried(model: Any, body: int, root: int) -> bool:
    """Whether a body hangs on the root by nothing but hinges and slides."""
    while body != root:
        first = model.body_jntadr[body]
        kinds = model.jnt_type[first : first + model.body_jntnum[body]]
        loose = np.isin(
            kinds, [int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)]
        )
        if body == 0 or loose.any() or model.body_mocapid[body] >= 0:
            return False
        body = model.body_parentid[body]
    return True


def place(
    data: Any, model: Any, names: list[str], followers: UrdfModel, values: dict[str, float]
) -> None:
    data.qpos[:] = model.qpos0
    for index, name in enumerate(names):
        if name in followers.movable:
            leader = followers.leader(name)
            value = leader.multiplier * values[leader.joint] + leader.offset
            data.qpos[model.jnt_qposadr[index]] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def jacobian(function: Any, model: Any, data: Any, index: int) -> np.ndarray:
    J = np.zeros((6, model.nv))
    function(model, data, J[:3], J[3:], index)
    return J

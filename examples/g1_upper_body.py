"""Two hands of a Unitree G1 learn to take a box, and take it in MuJoCo.

Waist and arms, 17 joints; the legs stand still. Nothing of the robot comes with this package:
give the path of its URDF, ``g1_29dof_rev_1_0.urdf`` of Unitree or of the package
example-robot-data.

    python examples/g1_upper_body.py g1_29dof_rev_1_0.urdf

Demonstrations are generated: both hands go from a start to the sides of a box that stands
elsewhere each time, by inverse kinematics (extra ``ik``). A mixture learns them, reproduces the
skill for boxes that it has not seen, and MuJoCo's physics follow with position servos.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch

from tpgmm_evaluation.policies.inverse_kinematics import follow_poses
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Situation,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)

HANDS = ("left_rubber_hand", "right_rubber_hand")
JOINTS = ["waist_*", *(f"{side}_{part}*" for side in ("left", "right") for part in
          ("shoulder_", "elbow", "wrist_"))]  # fmt: skip
#: Elbows bent, hands before the body [rad].
START = {"shoulder_pitch": 0.2, "elbow": 0.5}
RATE, SECONDS = 50, 4.0
#: Where the box may stand [m, before the pelvis], and its turn [rad].
LOWEST, HIGHEST, TURN = (0.28, -0.05, 0.05), (0.34, 0.05, 0.15), 0.25
#: From the middle of the box to a hand [m].
HALF_WIDTH = 0.12
STIFFNESS, DAMPING, STEPS = 500.0, 10.0, 20  # of the servos; physics per reference


def start_posture(robot: Robot) -> torch.Tensor:
    """Where every skill starts, shape (17,) [rad]."""
    values = [
        next((value for part, value in START.items() if part in name), 0.0)
        for name in robot.joint_names
    ]
    return torch.tensor(values, dtype=torch.float64)


def boxes(n: int, rng: np.random.Generator) -> list[Frame]:
    """Boxes that stand in different places, upright."""
    half = rng.uniform(-TURN, TURN, n) / 2
    positions = rng.uniform(LOWEST, HIGHEST, (n, 3))
    return [
        Frame(positions[i], [math.cos(half[i]), 0.0, 0.0, math.sin(half[i])]) for i in range(n)
    ]


def demonstrate(robot: Robot, box: Frame) -> Demonstration:
    """Both hands go to the sides of a box, on a minimum-jerk way in its frame."""
    start, time = start_posture(robot), torch.arange(int(RATE * SECONDS) + 1) / RATE
    s = (time.double() / SECONDS)[:, None]
    u = s**3 * (10 - 15 * s + 6 * s**2)
    state, ways = robot.state(start), {}
    for hand, side in zip(HANDS, (1.0, -1.0), strict=True):
        here = state.pose(hand)
        goal = box.transform(torch.tensor([0.0, side * HALF_WIDTH, 0.0], dtype=torch.float64))
        turn = quaternions.product(box.orientation, here.orientation)
        first, last = (q.expand(len(u), 4) for q in (here.orientation, turn))
        ways[hand] = Frame(
            here.position + u * (goal - here.position),
            quaternions.slerp(first, last, u[:, 0]),
        )
    joints = follow_poses(robot, ways, start, rate=RATE)
    return Demonstration(time.double(), joints, {"box": box}, robot.joint_names)


def grasp_error(robot: Robot, joints: torch.Tensor, box: Frame) -> float:
    """How far the hands are from the sides of the box at worst [mm]."""
    state, errors = robot.state(joints), []
    for hand, side in zip(HANDS, (1.0, -1.0), strict=True):
        goal = box.transform(torch.tensor([0.0, side * HALF_WIDTH, 0.0], dtype=torch.float64))
        errors.append(float((state.position(hand) - goal).norm()))
    return 1e3 * max(errors)


def simulation(urdf: str, joints: tuple[str, ...]) -> mujoco.MjModel:
    """The robot in MuJoCo, its pelvis fixed, with servos; shapes are not needed."""
    tree = ElementTree.fromstring(urdf)
    for link in tree.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    for asset in tree.findall("mujoco"):
        tree.remove(asset)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"))
    for body in spec.bodies[1:]:
        body.gravcomp = 1
    for joint in [joint for joint in spec.joints if joint.name not in joints]:
        spec.delete(joint)  # the legs stand still
    for name in joints:
        servo = spec.add_actuator(name=name, target=name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=STIFFNESS, kv=DAMPING)
    spec.option.timestep = 1 / (RATE * STEPS)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    model.dof_armature[:] = 0.03
    return model


def run(model: mujoco.MjModel, joints: np.ndarray, names: tuple[str, ...]) -> torch.Tensor:
    """Where the joints are after the servos have followed a motion."""
    data = mujoco.MjData(model)
    address = [int(model.joint(name).qposadr[0]) for name in names]
    data.qpos[address] = joints[0]
    for row in (*joints, *[joints[-1]] * RATE):  # a second to come to rest
        data.ctrl[:] = row
        mujoco.mj_step(model, data, STEPS)
    return torch.from_numpy(data.qpos[address].copy())


def main() -> None:
    """Demonstrate, learn, reproduce, simulate."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("urdf", type=Path, help="g1_29dof_rev_1_0.urdf")
    parser.add_argument("--demonstrations", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    robot = Robot.from_urdf(given.urdf, HANDS, joints=JOINTS)
    rng = np.random.default_rng(given.seed)
    shown = [demonstrate(robot, box) for box in boxes(given.demonstrations, rng)]
    worst = max(grasp_error(robot, d.joints[-1], d.frames["box"]) for d in shown)
    print(f"{len(shown)} demonstrations, {robot.n_joints} joints, grasps to {worst:.2f} mm")
    operators = [
        Stack(
            *(
                make(hand, "box")
                for hand in HANDS
                for make in (RelativePosition, RelativeOrientation)
            )
        ),
        Canonical(),
    ]
    model = TaskParameterizedGMM(6, operators, robot, random_state=0).fit(shown)
    physics = simulation(robot.config()["urdf"], robot.joint_names)
    unseen = boxes(3, rng)
    start = start_posture(robot)
    for box, motion in zip(
        unseen, model.predict([Situation(start, {"box": box}) for box in unseen]), strict=True
    ):
        planned = grasp_error(robot, motion.joints[-1], box)
        after = run(physics, motion.joints.numpy(), robot.joint_names)
        print(
            f"box at {np.round(box.position.numpy(), 3)}: {planned:.1f} mm planned, "
            f"{grasp_error(robot, after, box):.1f} mm in MuJoCo"
        )


if __name__ == "__main__":
    main()

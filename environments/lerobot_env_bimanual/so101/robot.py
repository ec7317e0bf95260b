"""Two simulated SO-101 arms, with what their servos do: play, softness, friction."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from lerobot_env_bimanual.robot_scene import BOX, PALM, TIMESTEP, add_geom
from tpgmm_datasets.robots import bi_so101_urdf

SIDES = ("left", "right")
#: Of each joint, between motor and link: from one end of the free play to the other [rad].
BACKLASH = math.radians(0.4)
#: What the joint behind a motor is called.
PLAY = "_play"
#: A servo STS3215: stiffness [N m / rad], so soft that gravity bends each of the joints that
#: carry the stretched arm by up to 2 degrees; damping [N m s / rad], friction and largest
#: torque [N m], and the inertia of its rotor behind the gears [kg m^2].
STIFFNESS, DAMPING, FRICTION, TORQUE, ROTOR = 17.8, 0.6, 0.05, 3.0, 0.028
#: Largest torque of the gripper, that of LeRobot's settings (half of the others') [N m].
GRIP_TORQUE = 1.0
#: Of the links from the shoulder to the jaw [kg]; where the capsule that stands for each ends,
#: in its frame [m], and how thick that is.
LINKS = {
    "shoulder_link": (0.100, (-0.03, -0.018, -0.05), 0.022),
    "upper_arm_link": (0.103, (-0.11257, -0.028, 0.0), 0.016),
    "lower_arm_link": (0.104, (-0.1349, 0.0052, 0.0), 0.015),
    "wrist_link": (0.079, (0.0, -0.0611, 0.0181), 0.016),
    "gripper_link": (0.087, (0.0, 0.0, -0.03), 0.018),
}
#: Half the sides of a jaw [m], its weight [kg], its middle in the frame of its link, and by how
#: much it is turned there [rad]: its end then meets that of the fixed jaw when it is closed.
JAW, JAW_MASS, JAW_MIDDLE, JAW_TURN = (0.004, 0.04, 0.008), 0.012, 0.04, -0.118
#: How far the moving jaw is beside the middle of the gripper, in its link's frame [m].
JAW_ASIDE = 0.019
#: Middle of the fixed jaw in the frame between the ends of the jaws, and half its length [m].
FIXED_JAW, FIXED_JAW_HALF = (0.008, 0.0, -0.03), 0.035
_DRAWN, _JAWS = (0.95, 0.75, 0.2, 1), (0.25, 0.25, 0.28, 1)


def hand_of(side: str) -> str:
    """Name the link between the ends of an arm's jaws."""
    return f"{side}_gripper_frame_link"


def so101_spec() -> mujoco.MjSpec:
    """Both arms, with a position servo, play and friction in each joint.

    Returns
    -------
    mujoco.MjSpec
        A joint NAME is where the motor is, as its encoder measures; NAME_play behind it is free
        within the backlash. Geoms ``l_jaw``, ``l_palm`` (the fixed jaw) and the right ones
        touch what has the bit ``PALM``.
    """
    spec = mujoco.MjSpec.from_string(bi_so101_urdf())
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint in list(spec.joints):
        _drive(spec, joint)
    for side in SIDES:
        _draw(spec, side)
    return spec


def _drive(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> None:
    """Give a joint a servo, and play behind it."""
    gripper = joint.name.endswith("gripper")
    joint.armature, joint.frictionloss = ROTOR, FRICTION
    motor = spec.add_actuator(name=joint.name, target=joint.name)
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    motor.set_to_position(kp=STIFFNESS, kv=DAMPING)
    torque = GRIP_TORQUE if gripper else TORQUE
    motor.forcelimited, motor.forcerange = True, (-torque, torque)
    half = BACKLASH / 2
    joint.parent.add_joint(
        name=joint.name + PLAY, type=joint.type, axis=joint.axis, pos=joint.pos,
        limited=True, range=(-half, half), armature=1e-4, frictionloss=1e-3,
        solref_limit=(4 * TIMESTEP, 1.0),
    )  # fmt: skip


def _draw(spec: mujoco.MjSpec, side: str) -> None:
    """Capsules for the links of an arm, and two jaws."""
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    base = spec.body(f"{side}_base_link")
    add_geom(base, BOX, (0.04, 0.03, 0.03), pos=(0.0, 0.0, 0.03), rgba=_DRAWN, mass=0.147)
    for name, (mass, end, radius) in LINKS.items():
        body, size = spec.body(f"{side}_{name}"), (radius, 0.0, 0.0)
        add_geom(body, capsule, size, fromto=(0, 0, 0, *end), rgba=_DRAWN, mass=mass)
    look = {"contype": PALM, "rgba": _JAWS}
    hand, jaw = spec.body(hand_of(side)), spec.body(f"{side}_moving_jaw_so101_v1_link")
    palm = (JAW[0], JAW[2], FIXED_JAW_HALF)
    add_geom(hand, BOX, palm, name=f"{side[0]}_palm", pos=FIXED_JAW, **look)
    turn = np.array((math.sin(JAW_TURN), -math.cos(JAW_TURN))) * JAW_MIDDLE
    add_geom(
        jaw, BOX, JAW, name=f"{side[0]}_jaw", pos=(*turn, JAW_ASIDE), mass=JAW_MASS,
        quat=(math.cos(JAW_TURN / 2), 0, 0, math.sin(JAW_TURN / 2)), **look,
    )  # fmt: skip

"""Carry and put: the left hand takes a bottle and puts it on a tray; every grasp differs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from tests.support.worlds import upper_body
from tpgmm_control import Controller
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_torch import Demonstration, Frame, Hold, Situation, TaskParameterizedGMM, quaternions
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.training.hold_detection import attach_holds, with_holds

HAND = "l_hand"
#: When the hand is at the bottle, when it lifts it, when it is at the tray, when it lets go.
ARRIVES, LIFTS, PUTS, LEAVES, LAST = 2.0, 2.6, 4.6, 5.2, 6.0
#: How the hand holds the bottle, seen from the bottle, and by how much that varies [m].
GRASP = Frame([0.0, 0.06, 0.0], [np.cos(-np.pi / 4), 0.0, np.sin(-np.pi / 4), 0.0])
SPREAD = 0.03
#: As things: the bottle goes to the tray, whatever the grasp was.
PUT = ("pose:l_hand@bottle", "pose:bottle@tray", "canonical")
#: As places alone: the hand goes where it went.
PLACES = ("pose:l_hand@bottle + pose:l_hand@tray", "canonical")


def operators(texts: Sequence[str] = PUT) -> list[Operator]:
    return [parse_operator(text) for text in texts]


@dataclass(frozen=True)
class Scene:
    """Where everything is at first, and how the hand will be in the bottle's frame."""

    start: Tensor
    bottle: Frame
    tray: Frame
    grasp: Frame

    def __getitem__(self, index: int) -> "Scene":
        return Scene(*(part[index] for part in vars(self).values()))

    @property
    def frames(self) -> dict[str, Frame]:
        return {"bottle": self.bottle, "tray": self.tray}

    @property
    def situation(self) -> Situation:
        return Situation(self.start, self.frames)


def scenes(n: int, seed: int = 0) -> Scene:
    """A batch of them."""
    rng = np.random.default_rng(seed)

    def poses(low: Sequence[float], high: Sequence[float]) -> Frame:
        half = np.radians(rng.uniform(-20, 20, n)) / 2
        zero = np.zeros(n)
        turns = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1)
        return Frame(rng.uniform(low, high, (n, 3)), turns)

    bottle = poses((0.24, 0.08, 0.10), (0.32, 0.16, 0.18))
    tray = poses((0.26, -0.06, 0.08), (0.32, 0.02, 0.14))
    spread = SPREAD * torch.from_numpy(rng.uniform(-1, 1, (n, 3)))
    grasp = Frame(GRASP.position + spread, GRASP.orientation.expand(n, 4))
    posture = BottleShaking(robot=upper_body()).neutral_posture()
    start = posture + torch.from_numpy(rng.uniform(-0.03, 0.03, (n, 17)))
    return Scene(start, bottle, tray, grasp)


@cache
def carries(n: int = 10, seed: int = 0, rate: float = 20.0) -> tuple[Demonstration, ...]:
    """Demonstrations by inverse kinematics, with the bottle recorded as it moves."""
    robot, scene = upper_body(), scenes(n, seed)
    time = torch.arange(int(LAST * rate) + 1, dtype=torch.float64) / rate
    first = robot.state(scene.start).pose(HAND)
    near = shifted(scene.bottle.compose(GRASP), -0.06, 0.06, 0.0)
    above = shifted(scene.tray, 0.0, 0.0, 0.12)
    joints, bottle, path, poses = scene.start, scene.bottle, [], []
    for now in time.tolist():
        wanted = between(first, near, now, 0.0, ARRIVES - 0.6)
        taken = scene.bottle.compose(scene.grasp)
        wanted = between(wanted, taken, now, ARRIVES - 0.8, ARRIVES)
        if now > LIFTS:
            carried = between(scene.bottle, above, now, LIFTS, PUTS - 0.7)
            wanted = between(carried, scene.tray, now, PUTS - 0.9, PUTS).compose(scene.grasp)
        wanted = between(wanted, shifted(wanted, -0.02, 0.05, 0.02), now, LEAVES, LAST)
        joints = reached(joints, wanted)
        if LIFTS < now <= PUTS:
            bottle = robot.state(joints).pose(HAND).compose(inverse(scene.grasp))
        path.append(joints)
        poses.append(bottle)
    moving = Frame(
        torch.stack([p.position for p in poses]), torch.stack([p.orientation for p in poses])
    )
    names, joints = robot.joint_names, torch.stack(path)
    return tuple(
        Demonstration(
            time, joints[:, i], {"bottle": moving[:, i], "tray": scene.tray[i]}, names
        )
        for i in range(n)
    )


def shifted(pose: Frame, *by: float) -> Frame:
    return Frame(pose.position + torch.tensor(by, dtype=torch.float64), pose.orientation)


def inverse(pose: Frame) -> Frame:
    return Frame([0.0, 0.0, 0.0]).seen_from(pose)


def between(a: Frame, b: Frame, now: float, begin: float, end: float) -> Frame:
    u = minimum_jerk(torch.tensor((now - begin) / (end - begin)).clamp(0, 1))
    turn = quaternions.slerp(a.orientation, b.orientation, u)
    return Frame(a.position + u * (b.position - a.position), turn)


def reached(joints: Tensor, wanted: Frame) -> Tensor:
    """Damped least squares, a few steps, from postures to those of the next instant."""
    for _ in range(3):
        state = upper_body().state(joints)
        turn = quaternions.product(
            wanted.orientation, quaternions.conjugate(state.orientation(HAND))
        )
        error = torch.cat((wanted.position - state.position(HAND), quaternions.log(turn)), -1)
        jacobian = state.jacobians[..., 0, :, :]
        gram = jacobian @ jacobian.mT + 1e-6 * torch.eye(6, dtype=torch.float64)
        step = jacobian.mT @ torch.linalg.solve(gram, error[..., None])
        joints = joints + step[..., 0]
    return joints


def at_first(shown: Demonstration) -> Demonstration:
    """The same with the bottle recorded once, where it was at first."""
    frames = {name: f[0] if f.batch_shape else f for name, f in shown.frames.items()}
    return replace(shown, frames=frames)


def placed(model: TaskParameterizedGMM, scene: Scene, slips: Tensor) -> Tensor:
    """How far from the tray bottles are put [m], (n,), that were grasped with an error.

    Taking them moves them by ``slips`` (n, 3) in the hand; they are seen at each tick.
    """
    robot, grasp = upper_body(), None
    controller = Controller(model.skill, scene.start, scene.frames)
    bottle = scene.bottle
    for now in model.time_.tolist():
        if now >= HELD.end:
            break
        hand = robot.state(controller.reference).pose(HAND)
        if now >= HELD.begin:
            slipped = Frame(bottle.position + slips, bottle.orientation)
            grasp = slipped.seen_from(hand) if grasp is None else grasp
            bottle = hand.compose(grasp)
        controller.step(now - controller.time, frames={**scene.frames, "bottle": bottle})
    return (bottle.position - scene.tray.position).norm(dim=-1)


#: When the bottle is held.
HELD = Hold("bottle", HAND, (ARRIVES + LIFTS) / 2, (PUTS + LEAVES) / 2)


@cache
def held_carries() -> list[Demonstration]:
    """The demonstrations with the holds that are found in them."""
    return attach_holds(carries(), upper_body())


@cache
def carrying_model(texts: Sequence[str] = PUT, holds: bool = True) -> TaskParameterizedGMM:
    """Fitted to the ten; not to be changed."""
    shown, robot = carries(), upper_body()
    shown = attach_holds(shown, robot) if holds else with_holds(shown, ())
    return TaskParameterizedGMM(15, operators(texts), robot, tol=1e-2).fit(shown)

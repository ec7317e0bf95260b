"""Poses and Jacobians of both hands, beside pinocchio."""

from collections.abc import Callable, Iterator

import torch

from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings
from benchmarks.timing import in_turns, medians, per_call
from tpgmm_datasets.bottle.skill import HANDS, upper_body
from tpgmm_datasets.robots import upper_body_urdf

__all__ = ["measure"]


def measure(settings: Settings) -> Iterator[Row | Omitted]:
    """Measure a posture of 17 joints, and a batch of them, in float64."""
    robot = upper_body()
    try:
        theirs = _pinocchio()
    except ImportError as error:
        yield Omitted("kinematics of pinocchio", f"{error} (pip install 'tpgmm-torch[bench]')")
        return
    generator = torch.Generator().manual_seed(settings.seed)
    span = robot.upper - robot.lower
    many = settings.size(1024, 4)
    postures = robot.lower + span * torch.rand(many, 17, dtype=span.dtype, generator=generator)
    rows = list(postures.numpy())
    calls, rounds = settings.size(300, 3), settings.rounds(9)
    measurements = {
        "one": per_call(lambda: robot.state(postures[0]), calls),
        "one, theirs": per_call(lambda: theirs(rows[0]), calls),
        "many": per_call(lambda: robot.state(postures), 1),
        "many, theirs": per_call(lambda: list(map(theirs, rows)), 1),
    }
    with torch.inference_mode():
        taken = medians(in_turns(measurements, rounds, warm_up=settings.full))
    micro = {name: 1e6 * value for name, value in taken.items()}
    work = "Robot.state: poses and Jacobians of two hands, 17 joints, float64"
    one = ("pinocchio, in numpy", micro["one, theirs"])
    yield Row(f"{work}, one posture", "us", micro["one"], *one, rounds=rounds)
    each = ("pinocchio, one after the other", micro["many, theirs"] / many)
    work += f", {many} postures: per posture"
    yield Row(work, "us", micro["many"] / many, *each, rounds=rounds)


def _pinocchio() -> Callable[[object], object]:
    """Make pinocchio's fastest way: all joint Jacobians at once, then the hands'."""
    import pinocchio

    model = pinocchio.buildModelFromXML(upper_body_urdf())
    data = model.createData()
    hands = [model.getFrameId(hand) for hand in HANDS]
    axes = pinocchio.LOCAL_WORLD_ALIGNED

    def state(joints: object) -> object:
        pinocchio.computeJointJacobians(model, data, joints)
        pinocchio.updateFramePlacements(model, data)
        jacobians = [pinocchio.getFrameJacobian(model, data, hand, axes) for hand in hands]
        return [data.oMf[hand].homogeneous for hand in hands], jacobians

    return state

"""Rows of Table I for many operators at once, against each operator's own."""

from dataclasses import fields

import pytest
import torch

from tests.support.robot_zoo import random_joints, upper_body
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Frame,
    RelativeOrientation,
    RelativePosition,
    RobotState,
    Stack,
    quaternions,
)
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_torch.operators.pose_terms import pose_terms

STACKS = {
    "one": Stack(RelativePosition("l_hand", "cup")),
    "absolute": Stack(AbsoluteOrientation("r_hand", gain=1.0), AbsolutePosition("l_hand")),
    "two frames": Stack(
        Stack(RelativeOrientation("r_hand", "lid"), RelativePosition("l_hand", "cup")),
        RelativeOrientation("l_hand", "cup", gain=1.1),
        AbsolutePosition("r_hand"),
    ),
    "hand to hand": Stack(
        RelativeOrientation("r_hand", "l_hand", gain=1.2),
        RelativePosition("l_hand", "cup"),
        RelativePosition("r_hand", "l_hand"),
    ),
    "things": Stack(
        RelativePosition("cup", "lid"),
        RelativeOrientation("cup", "lid"),
        AbsolutePosition("cup"),
        RelativePosition("r_hand", "cup", held=True),
        RelativeOrientation("r_hand", "cup", held=True),
        RelativePosition("l_hand", "cup", held=True),
        RelativePosition("l_hand", "cup"),
        RelativeOrientation("lid", "cup", held=True),
        RelativePosition("cup", "l_hand"),
    ),
}


class SaysItself(RobotState):
    """A state whose orientations are mapped one by one."""

    def orientation_map(self, link, gain):
        return super().orientation_map(link, gain)


def scene(*batch: int) -> tuple[RobotState, dict[str, Frame]]:
    generator = torch.Generator().manual_seed(len(batch))
    joints = random_joints(upper_body(), 6)[: max(1, torch.Size(batch).numel())]
    state = upper_body().state(joints.reshape(*batch, 17))
    frames = {}
    for name in ("cup", "lid"):
        options = {"generator": generator, "dtype": torch.float64}
        turn = quaternions.normalize(torch.randn(*batch, 4, **options))
        frames[name] = Frame(torch.randn(*batch, 3, **options), turn)
    return state, frames


def one_by_one(state: RobotState) -> SaysItself:
    return SaysItself(*(getattr(state, field.name) for field in fields(state)))


#: How something is held.
GRASP = Frame([0.05, -0.12, 0.08], [0.5, -0.5, 0.1, 0.7])


@pytest.mark.parametrize("batch", [(), (1,), (6,), (2, 3)])
@pytest.mark.parametrize("stack", STACKS.values(), ids=list(STACKS))
def test_together_is_one_by_one(stack, batch):
    state, frames = scene(*batch)
    together = stack.linearize(state, frames)
    expected = stack.linearize(one_by_one(state), frames)
    assert together.present is not None
    assert expected.present is None
    for name in ("jacobian", "matrix", "displacement"):
        torch.testing.assert_close(
            getattr(together, name), getattr(expected, name), rtol=0, atol=1e-14
        )
    coordinates = stack.coordinates(state, frames)
    turned = torch.zeros_like(coordinates)
    for start in stack.quaternion_starts(upper_body()):
        turned[..., start : start + 4] = coordinates[..., start : start + 4]
    torch.testing.assert_close(together.present, turned, rtol=0, atol=1e-14)


GRASPS = {
    "free": lambda state, frames: state,
    "known to be free": lambda state, frames: state.with_link("lid", None, frames["lid"]),
    "held": lambda state, frames: state.with_link("cup", "r_hand", GRASP),
    "both": lambda state, frames: (
        state.with_link("spoon", "l_hand", GRASP)
        .with_link("lid", "l_hand", GRASP)
        .with_link("cup", "r_hand", GRASP)
    ),
    "one on the other": lambda state, frames: state.with_link("cup", "r_hand", GRASP).with_link(
        "lid", "cup", GRASP
    ),
}


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
@pytest.mark.parametrize("held", GRASPS.values(), ids=list(GRASPS))
@pytest.mark.parametrize("name", ["things", "hand to hand", "two frames"])
def test_together_is_one_by_one_whatever_is_held(name, held, batch):
    state, frames = scene(*batch)
    assert_together(STACKS[name], held(state, frames), frames)


def test_robots_of_a_batch_hold_different_things():
    state, frames = scene(6)
    state = state.with_link("cup", None, frames["cup"])
    state = state.with_link("cup", "r_hand", GRASP, torch.arange(6) % 3 == 0)
    state = state.with_link("cup", "l_hand", GRASP, torch.arange(6) % 3 == 1)
    assert_together(STACKS["things"], state, frames)
    together = STACKS["things"].linearize(state, frames)
    silent = together.noise.unflatten(-1, (-1, 3))[..., 0].bool()
    assert (
        silent.tolist()
        == [
            [False, False, False, True, True, False, False, False, False],
            [False, False, False, False, False, True, False, False, True],
            [True, True, True, False, False, False, False, True, False],
        ]
        * 2
    )


def assert_together(stack, state, frames):
    together = stack.linearize(state, frames)
    expected = stack.linearize(one_by_one(state), frames)
    assert together.present is not None and expected.present is None
    for name in ("jacobian", "matrix", "displacement"):
        one, other = getattr(together, name), getattr(expected, name)
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)
        assert torch.equal(one == 0, other == 0) or name == "jacobian"
    zero = torch.zeros_like(together.displacement)
    one, other = (zero if at.noise is None else at.noise for at in (together, expected))
    assert torch.equal(one, other)
    assert bool((together.jacobian[one == 1] == 0).all())


def test_one_frame_serves_many_robots_and_many_frames_one():
    stack = STACKS["two frames"]
    state, frames = scene(6)
    single = {name: frame[0] for name, frame in frames.items()}
    for few, many in ((state, single), (state[0], frames)):
        together = stack.linearize(few, many)
        expected = stack.linearize(one_by_one(few), many)
        torch.testing.assert_close(together.displacement, expected.displacement)
        for row in range(6):
            at, there = (
                (x[row] if x.ndim == 3 else x) for x in (together.matrix, expected.matrix)
            )
            torch.testing.assert_close(at, there)


def test_operators_that_differ_speak_for_themselves():
    links, like = upper_body().links, upper_body().lower

    class Mine(AbsolutePosition):
        pass

    for other in (Canonical(), Mine("l_hand")):
        operators = (AbsolutePosition("l_hand"), other)
        assert pose_terms(operators, links, like.dtype, like.device) is None


def test_a_frame_that_is_not_there_is_named():
    state, frames = scene()
    with pytest.raises(UnknownNameError, match=r"'cup'.*'lid'"):
        STACKS["two frames"].linearize(state, {"lid": frames["lid"]})


@pytest.mark.parametrize("batch", [(), (1,), (6,), (2, 3)])
def test_what_a_compiler_is_given_is_the_same(batch, monkeypatch):
    state, frames = scene(*batch)
    stack = STACKS["two frames"]
    expected = stack.linearize(state, frames)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    traced = stack.linearize(state, frames)
    for field in fields(traced):
        one, other = getattr(traced, field.name), getattr(expected, field.name)
        torch.testing.assert_close(one, other, rtol=0, atol=1e-14)

"""Where objects were, in a recording of a robot that held them: as places, and as things."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.robots.kinematics import RobotState


def held_objects(
    state: RobotState,
    time: Tensor,
    frames: Frames,
    holds: Sequence[Hold],
    *,
    attached: bool = False,
) -> tuple[RobotState, dict[str, Frame]]:
    """Add objects that were held as links, and find the places where they were free.

    Parameters
    ----------
    state : RobotState
        Of a recording, with leading shape (T,).
    time : Tensor of shape (T,)
        Seconds.
    frames : mapping of str to Frame
        Recorded poses: one for each instant; or one, where an object was when it was first
        held, from where the link that holds it carries it.
    holds : sequence of Hold
        In the order of time.
    attached : bool, default=False
        Whether the joints move what is held; else their Jacobians are zero.

    Returns
    -------
    state : RobotState
        With the objects that were held, wherever they were: what an operator refers to as a
        thing.
    frames : dict of str to Frame
        While an object is held, its frame is where it was last free: a place. It is free
        neither while one link hands it on to another.
    """
    places = dict(frames)
    for name in dict.fromkeys(hold.frame for hold in holds):
        recorded, pose = bool(frames[name].batch_shape), frames[name].expand(time.shape)
        instants = torch.arange(len(time), device=time.device)
        last_free, free, held = instants.clone(), -1, []
        for hold in holds:
            # the first instants that are not before
            ends = time.new_tensor([hold.begin, hold.end])
            begin, end = torch.searchsorted(time.contiguous(), ends).tolist()
            if hold.frame == name and begin < end:
                # from hand to hand it is not free between
                last_free[begin:end] = last_free[begin - 1] if begin == free else begin
                free = end
                pose = pose if recorded else _carry_object(state, pose, hold.link, begin, end)
                held.append((hold.link, (instants >= begin) & (instants < end)))
        state = state.with_link(name, None, pose)
        for link, where in held if attached else ():
            state = state.with_link(name, link, pose.seen_from(state.pose(link)), where)
        places[name] = pose[last_free]
    return state, places


def _carry_object(state: RobotState, pose: Frame, link: str, begin: int, end: int) -> Frame:
    """Compute poses (T,) of what a link carries between two instants, then leaves."""
    hand = state.pose(link)
    grasp = pose[begin].seen_from(hand[begin])
    instants = torch.arange(len(hand.position), device=hand.position.device)
    there = hand[instants.clamp(max=min(end, len(instants) - 1))].compose(grasp)
    before = (instants <= begin)[:, None]
    return Frame.from_checked(
        torch.where(before, pose.position, there.position),
        torch.where(before, pose.orientation, there.orientation),
    )

"""Contacts of several motions among obstacles, each in its own situation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from tpgmm_control.obstacles import Contact, Scene, find_contacts
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.data.trajectories import Trajectory


def contacts(
    scene: Scene,
    motions: Iterable[Trajectory],
    situations: Iterable[Situation],
    holds: Sequence[Hold],
) -> Iterator[tuple[int, Contact]]:
    """Find contacts in motions, each in its situation, with the number of the motion.

    Parameters
    ----------
    scene : Scene
        With the obstacles.
    motions, situations : iterable of Trajectory, iterable of Situation
        As many of each.
    holds : sequence of Hold
        What the robot holds meanwhile.
    """
    for number, (one, situation) in enumerate(zip(motions, situations, strict=True)):
        frames = situation.frames_at(one.time.cpu())
        for contact in find_contacts(scene, one.time, one.joints, frames, holds):
            yield number, contact

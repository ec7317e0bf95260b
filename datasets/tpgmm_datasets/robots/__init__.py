"""Robot descriptions that come with the package, and robots written as text."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from tpgmm_torch.data.pose_names import is_gripper
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import UrdfModel

__all__ = ["bi_so101_urdf", "end_links", "parse_robot", "so101_urdf", "upper_body_urdf"]

#: Two arms as LeRobot's ``bi_so_follower`` has them, their bases side by side.
BI_SO101 = "left=so101@0,0.2,0;right=so101@0,-0.2,0"
#: How one of several robots is written.
PART = "NAME=FILE@X,Y,Z (metres), perhaps with ,YAW (radians) or ,QW,QX,QY,QZ behind it"
#: How hands are called that have no joint of a gripper.
HAND = re.compile("(.*_)?(l|r|left|right)_hand")


def upper_body_urdf() -> str:
    """Read the URDF of a 17-joint upper body: three waist joints and two arms of seven.

    Joints, limits and masses are the published figures of the COMAN humanoid (the comment
    in the file names the source); the shapes are ours. The links of interest are ``l_hand``
    and ``r_hand``. At zero the arms hang down; x points forward, y left, z up.

    Returns
    -------
    str
        The text, as :meth:`tpgmm_torch.Robot.from_urdf` takes it.
    """
    return resources.files(__name__).joinpath("upper_body.urdf").read_text(encoding="utf-8")


def so101_urdf() -> str:
    """Read the URDF of an SO-101 arm: five joints and a gripper.

    Joints have the names of LeRobot's motors, and their figures are the published ones (the
    comment in the file names the source); shapes are not in it. The link of interest is
    ``gripper_frame_link``, between the ends of the jaws. ``gripper`` moves one jaw.

    Returns
    -------
    str
        The text, as :meth:`tpgmm_torch.Robot.from_urdf` takes it.

    Examples
    --------
    >>> from tpgmm_torch import Robot
    >>> arm = Robot.from_urdf(so101_urdf(), links=["gripper_frame_link"])
    >>> places = {"left": [0.0, 0.2, 0.0], "right": [0.0, -0.2, 0.0]}
    >>> Robot.combine(places, left=arm, right=arm).links
    ('left_gripper_frame_link', 'right_gripper_frame_link')
    """
    return resources.files(__name__).joinpath("so101.urdf").read_text(encoding="utf-8")


def bi_so101_urdf() -> str:
    """Make the URDF of two SO-101 arms, named as LeRobot's ``bi_so_follower`` names its motors.

    The bases are 0.4 m apart in the frame ``world``: the left one at y = 0.2 m, the right one
    at y = -0.2 m. Where yours stand otherwise, :func:`parse_robot` puts them there.

    Returns
    -------
    str
        The text, as :meth:`tpgmm_torch.Robot.from_urdf` takes it.
    """
    return parse_robot(BI_SO101).model.text


#: Robots that can be named: what describes each.
ROBOTS = {"bi_so101": bi_so101_urdf, "so101": so101_urdf, "upper_body": upper_body_urdf}


def parse_robot(text: str | Sequence[str], links: Sequence[str] = (), **settings: Any) -> Robot:
    """Make the robot that a text stands for.

    Parameters
    ----------
    text : str or sequence of str
        The path of a URDF or an MJCF, the text of one, or ``"so101"``, ``"bi_so101"`` or
        ``"upper_body"``. Of several robots, in a list or joined by ``;``, each with its name
        and the place of its base [m]: ``"left=so101@0,0.2,0;right=arm.urdf@0,-0.2,0"``; behind
        the position perhaps a yaw [rad] or a quaternion (w, x, y, z).
    links : sequence of str, optional
        By default the :func:`end_links`.
    **settings
        As for :meth:`tpgmm_torch.Robot.from_urdf`.

    Raises
    ------
    DataError, UnknownNameError
        If the text has another form, or as for :meth:`tpgmm_torch.Robot.from_urdf`.

    Examples
    --------
    >>> parse_robot("bi_so101").links
    ('left_gripper_frame_link', 'right_gripper_frame_link')
    """
    texts = [text] if isinstance(text, str) else list(text)
    one = len(texts) == 1 and (texts[0].lstrip().startswith("<") or Path(texts[0]).is_file())
    parts = texts if one else [part.strip() for part in ";".join(texts).split(";")]
    one |= len(parts) == 1 and "=" not in parts[0]
    model = (_make_robot(parts[0]) if one else _combine_robots(parts)).model
    return Robot.from_urdf(model.text, links or end_links(model), **settings)


def _combine_robots(parts: Sequence[str]) -> Robot:
    robots: dict[str, Any] = {}
    places = {}
    for part in parts:
        match = re.fullmatch(r"(?!poses=|fixed=|base=)([A-Za-z]\w*)=(.+)@([^@]+)", part)
        if match is None or match[1] in robots:
            twice = "is there twice; one" if match else "is not"
            raise DataError(f"robot {part!r} {twice} {PART}; got {list(parts)}")
        places[match[1]], robots[match[1]] = _parse_place(part, match[3]), _make_robot(match[2])
    return Robot.combine(places, **robots)


def _make_robot(text: str) -> Robot:
    if "<" not in text and text not in ROBOTS and not Path(text).exists():
        raise DataError(f"there is no file {text!r}; robots of the package are {[*ROBOTS]}")
    return Robot.from_file(ROBOTS[text]() if text in ROBOTS else text, ())


def _parse_place(part: str, text: str) -> list[float]:
    """Parse the position and quaternion of a base."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4, 7) or (len(numbers) == 4 and abs(numbers[3]) > math.tau):
        raise DataError(f"robot {part!r} is not {PART}")
    if len(numbers) == 4:
        yaw = numbers.pop() / 2
        numbers += [math.cos(yaw), 0.0, 0.0, math.sin(yaw)]
    return numbers


def end_links(model: UrdfModel) -> tuple[str, ...]:
    """Find the links of interest that a description tells of; none where it does not.

    What carries a gripper's joints, known by their names, or the one link at the end of what is
    fixed to it; of the upper body that comes with the package, its hands.

    Parameters
    ----------
    model : UrdfModel
        Description of a robot, ``robot.model``.

    Examples
    --------
    >>> end_links(parse_robot("so101").model)
    ('gripper_frame_link',)
    """
    carriers = {joint.parent for joint in model.movable.values() if is_gripper(joint.name)}
    carriers |= {link for link in model.links if HAND.fullmatch(link)}
    parents = {joint.child: joint.parent for joint in model.joints}
    highest = {link for link in carriers if not _is_below(link, carriers, parents)}
    return tuple(_find_tip(link, model) for link in model.links if link in highest)


def _is_below(link: str, wanted: Collection[str], parents: Mapping[str, str]) -> bool:
    """Check if a link is below one of the wanted ones."""
    while link in parents:
        link = parents[link]
        if link in wanted:
            return True
    return False


def _find_tip(carrier: str, model: UrdfModel) -> str:
    """Find the one link at the end of what is fixed to a link; else return that link."""
    parents, fixed = {joint.parent for joint in model.joints}, [carrier]
    for link in fixed:  # which grows
        fixed += [j.child for j in model.joints if j.parent == link and not j.movable]
    tips = [link for link in fixed if link not in parents]
    return tips[0] if len(tips) == 1 else carrier

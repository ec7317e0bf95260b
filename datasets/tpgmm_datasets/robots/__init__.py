"""Robot descriptions that come with the package."""

from importlib import resources

__all__ = ["so101_urdf", "upper_body_urdf"]


def upper_body_urdf() -> str:
    """The URDF of a 17-joint upper body: three waist joints and two arms of seven.

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
    """The URDF of an SO-101 arm: five joints and a gripper.

    Joints have the names of LeRobot's motors, and their figures are the published ones (the
    comment in the file names the source); shapes are not in it. The link of interest is
    ``gripper_frame_link``, between the ends of the jaws. ``gripper`` moves one jaw.

    Returns
    -------
    str
        The text, as :meth:`tpgmm_torch.Robot.from_urdf` takes it.

    Examples
    --------
    >>> from tpgmm_torch import Frame, Robot
    >>> arm = Robot.from_urdf(so101_urdf(), links=["gripper_frame_link"])
    >>> places = {"left": Frame([0.0, 0.2, 0.0]), "right": Frame([0.0, -0.2, 0.0])}
    >>> Robot.combine(places, left=arm, right=arm).links
    ('left_gripper_frame_link', 'right_gripper_frame_link')
    """
    return resources.files(__name__).joinpath("so101.urdf").read_text(encoding="utf-8")

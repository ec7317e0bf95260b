"""Robot descriptions that come with the package."""

from importlib import resources

__all__ = ["upper_body_urdf"]


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

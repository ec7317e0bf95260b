"""Task-parameterised Gaussian mixtures in PyTorch: robot skills from a few demonstrations."""

from importlib.metadata import version

from tpgmm_torch.demonstrations import Demonstration, Situation
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.frames import Frame
from tpgmm_torch.kinematics import Kinematics, RobotState
from tpgmm_torch.mixture import BlockGaussianMixture
from tpgmm_torch.operators import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Linearization,
    Operator,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.poses import Poses
from tpgmm_torch.regression import Estimate
from tpgmm_torch.robots import Robot
from tpgmm_torch.trajectories import Candidate, Trajectory

__all__ = [
    "AbsoluteOrientation",
    "AbsolutePosition",
    "BlockGaussianMixture",
    "Candidate",
    "Canonical",
    "Demonstration",
    "Estimate",
    "Frame",
    "Kinematics",
    "Linearization",
    "Operator",
    "Poses",
    "RelativeOrientation",
    "RelativePosition",
    "Robot",
    "RobotState",
    "Situation",
    "Stack",
    "TaskParameterizedGMM",
    "Trajectory",
]

__version__ = version("tpgmm-torch")

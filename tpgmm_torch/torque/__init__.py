"""Torques for a skill: poses, postures and forces fused in torque space."""

from tpgmm_torch.torque.controller import TorqueController
from tpgmm_torch.torque.dynamics import Dynamics, MujocoDynamics
from tpgmm_torch.torque.gains import TorqueGains

__all__ = ["Dynamics", "MujocoDynamics", "TorqueController", "TorqueGains"]

"""Torques for a skill: poses, postures and forces fused in torque space."""

from tpgmm_control.torque.controller import TorqueController
from tpgmm_control.torque.dynamics import Dynamics, MujocoDynamics
from tpgmm_control.torque.gains import TorqueGains

__all__ = ["Dynamics", "MujocoDynamics", "TorqueController", "TorqueGains"]

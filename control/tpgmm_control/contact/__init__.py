"""Contact: forces that a skill asks for, reached by moving references."""

from tpgmm_control.contact.admittance import Admittance, Offsets

__all__ = ["Admittance", "Offsets"]

"""Policies that are trained once and rolled out with different settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Self

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from tpgmm_torch.exceptions import DataError, UnknownNameError

#: What 0.1.0 does by default: play the skill by the clock, with what is seen at the start.
OPEN_LOOP = "tpgmm-open-loop"
#: Sees and follows everything, but goes by the clock, however far the skill has come.
EVEN_CLOCK = "tpgmm-even-clock"
#: Variants with a name of their own. A gap at the start is no reason to give up here.
NAMED: Mapping[str, str] = MappingProxyType(
    {
        OPEN_LOOP: "tpgmm --policy.control.closed_loop=false --policy.control.clock=even "
        "--policy.control.follow_frames=false --policy.control.largest_start_gap=null",
        EVEN_CLOCK: "tpgmm --policy.control.clock=even",
    }
)
OPTION = "--policy."


@dataclass(frozen=True)
class Variant:
    """A trained policy and the settings with which it is used.

    Parameters
    ----------
    base : str
        What is trained.
    overrides : tuple of str
        ``"field=value"`` for fields of its configuration.
    """

    base: str
    overrides: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a name, or a name and settings: ``"tpgmm --policy.control.blend=0"``.

        Raises
        ------
        DataError, UnknownNameError
            If a setting cannot be read, or is no field of a policy that has settings.
        """
        base, *options = NAMED.get(text, text).split()
        known = {field.name for field in fields(TPGMMConfig)}
        for option in options:
            name, equals, _ = option.removeprefix(OPTION).partition("=")
            if not option.startswith(OPTION) or not equals:
                raise DataError(
                    f"settings of a policy look like {OPTION}control.feedback=observation, "
                    f"got {option!r} in {text!r}"
                )
            if not base.startswith("tpgmm"):
                raise DataError(f"only tpgmm policies take settings, got {text!r}")
            if name.partition(".")[0] not in known:
                raise UnknownNameError("field", name, "the policy's configuration", known)
        return cls(base, tuple(option.removeprefix(OPTION) for option in options))

    @property
    def arguments(self) -> list[str]:
        """The settings as LeRobot's configurations take them on top of a file."""
        return [f"--{override}" for override in self.overrides]

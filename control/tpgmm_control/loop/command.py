"""Stage *command*: what is sent to robots at one tick, and the status of each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_control.loop.clock import Patience
from tpgmm_control.loop.gates import Gates
from tpgmm_control.loop.locate import Mode, Progress
from tpgmm_control.sensing.inputs import Inputs
from tpgmm_control.sensing.servo import Flags
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.estimate import Estimate

__all__ = ["Command", "Status"]


class Status(StrEnum):
    """Whether a robot follows its skill; in tensors by its ``code``."""

    RUNNING = "running"  #: the skill goes on
    WAITING = "waiting"  #: for a joint that does not follow, or for the end of a skill
    DISPLACED = "displaced"  #: somebody else has moved it
    HOLDING = "holding"  #: it stands: inputs cannot be trusted, or it has tried in vain
    FINISHED = "finished"  #: it stands at the end of the skill
    STOPPED = "stopped"  #: it was waited for as long as the clock allows, and stands for good

    @property
    def code(self) -> int:
        """Its number, from 0 for running on."""
        return _CODES[self]


#: Why a robot is waited for, of which the readings are the same to the last bit.
FROZEN = "its readings do not change: it stands, or they are dead"
_STATUSES = tuple(Status)
_CODES = {status: code for code, status in enumerate(_STATUSES)}


@dataclass(frozen=True, eq=False)
class Command:
    """Command to a batch of robots at one tick.

    What a tick needs not be asked for every time (stiffness, damping, the status in words) is
    worked out when it is.

    Parameters
    ----------
    reference : Tensor of shape (..., n_joints)
        Where the joints should be [rad or m].
    velocity : Tensor of shape (..., n_joints)
        How fast they should move there [rad/s or m/s].
    time : Tensor of shape (...)
        Each robot's progress in the skill [s].
    estimate : Estimate
        What the reference was made from.
    codes : Tensor of shape (...)
        :attr:`Status.code` of each robot, of an integer type.
    reasons : mapping of tuple of int to str, optional
        Why a robot does not simply run, by its index in the batch, ``()`` for a single robot.
    impedance : Impedance, optional
        What stiffness and damping are made with.
    compute_novelty : callable, optional
        What gives :attr:`novelty`.
    relocalized : Tensor of bool of shape (...), optional
        Whether its time was set to another one of the skill at this tick.
    offset : Tensor of shape (..., n_joints), optional
        What readings exceed positions by, as it is estimated: sag, payload, an encoder that
        slipped [rad or m].
    torque : Tensor of shape (..., n_joints), optional
        Of each joint, gravity and the bias of the motion included, from a
        :class:`~tpgmm_control.torque.TorqueController` [N m or N].
    """

    reference: Tensor
    velocity: Tensor
    time: Tensor
    estimate: Estimate
    codes: Tensor
    reasons: Mapping[tuple[int, ...], str] = field(default_factory=dict)
    impedance: Impedance | None = None
    compute_novelty: Callable[[], Tensor] | None = None
    relocalized: Tensor | None = None
    offset: Tensor | None = None
    torque: Tensor | None = None

    def __repr__(self) -> str:
        return (
            f"Command(reference of shape {tuple(self.reference.shape)}, "
            f"time={self.time.tolist()}, status={self.status})"
        )

    @property
    def status(self) -> Any:
        """A :class:`Status`, of a batch in (nested) lists.

        It compares with text: ``command.status == "running"``.
        """
        return _statuses(self.codes.tolist())

    def reason(self, robot: int | tuple[int, ...] = ()) -> str:
        """Why a robot does not simply run, in words.

        Parameters
        ----------
        robot : int or tuple of int
            Its index in the batch.

        Returns
        -------
        str
            Empty if it runs.
        """
        return self.reasons.get((robot,) if isinstance(robot, int) else robot, "")

    def of(self, status: Status | str) -> Tensor:
        """Which robots have a status, as truth values (...).

        Parameters
        ----------
        status : Status or str

        Raises
        ------
        UnknownNameError
            If there is no such status.
        """
        if status not in _CODES:
            raise UnknownNameError("status", str(status), "a command", _STATUSES)
        return torch.eq(self.codes, _CODES[Status(status)])

    @cached_property
    def novelty(self) -> Tensor | None:
        """How new its situation is to the model, of each robot (...).

        1 is as far from the demonstrations as the one of these that is furthest from the
        others: the start posture, and where objects are now or, if held, were last free. None
        where the model does not know its demonstrations.
        """
        return None if self.compute_novelty is None else self.compute_novelty()

    @property
    def covariance(self) -> Tensor:
        """Of the fused Gaussian that the reference was made from (..., n_joints, n_joints)."""
        return self.estimate.covariance

    @cached_property
    def stiffness(self) -> Tensor:
        """Of each joint (..., n_joints) [N m/rad]: stiff where demonstrations agree."""
        return self.stiffness_matrix.diagonal(dim1=-2, dim2=-1)

    @cached_property
    def damping(self) -> Tensor:
        """Of each joint (..., n_joints) [N m s/rad]."""
        return self._impedance.joints.diagonal_damping(self.stiffness)

    @cached_property
    def stiffness_matrix(self) -> Tensor:
        """With the couplings between joints (..., n_joints, n_joints) [N m/rad]."""
        return self._impedance.joints.matrix(self.covariance)

    def link_stiffness(self, link: str) -> Tensor:
        """In task space at the reference: [translation; rotation] (..., 6, 6) [N/m, N m/rad].

        Parameters
        ----------
        link : str

        Raises
        ------
        UnknownNameError
            If the robot has no such link.
        """
        return self._impedance.at_link(link, self.reference, self.covariance)

    @property
    def _impedance(self) -> Impedance:
        if self.impedance is None:
            raise DataError(
                "this command has no stiffness: give the controller an impedance "
                "(Impedance(kinematics))"
            )
        return self.impedance


def _statuses(codes: Any) -> Any:
    """In nested lists as the codes are."""
    return _STATUSES[codes] if isinstance(codes, int) else [_statuses(part) for part in codes]


def refused(last: Command, reason: str) -> Command:
    """The last command, while nothing moves.

    Parameters
    ----------
    last : Command
    reason : str
        Why that is so.
    """
    codes = torch.full_like(last.codes, Status.HOLDING.code)
    reasons = dict.fromkeys(np.ndindex(*codes.shape), reason)
    return replace(last, codes=codes, reasons=reasons)


def statuses(
    batch: Sequence[int],
    names: Sequence[str],
    progress: Sequence[Progress],
    wanted: Tensor,
    ended: Flags | None,
    held: Sequence[tuple[Flags | None, str]],
    halted: Flags | None,
    inputs: Inputs | None,
    gates: Gates | None = None,
    obstructed: Mapping[int, tuple[bool, str]] = MappingProxyType({}),
    patience: Patience | None = None,
) -> tuple[NDArray[np.int8], Mapping[tuple[int, ...], str]]:
    """The status of each robot, and why one does not simply run.

    Parameters
    ----------
    batch : sequence of int
        Shape of the batch; robots are (B,) in what follows.
    names : sequence of str
        Of the joints.
    progress : sequence of Progress
        Of each robot.
    wanted : Tensor of shape (..., n_joints)
        Where robots should be.
    ended : bool array of shape (B,), optional
        Robots that have been at the end for a tick.
    held : sequence of (bool array of shape (B,), str)
        Robots that stand for a reason; the last one counts.
    halted : bool array of shape (B,), optional
        Robots without accepted inputs.
    inputs : Inputs, optional
        Why that is so.
    gates : Gates, optional
        What robots wait for at the end of a skill.
    obstructed : mapping of int to (bool, str)
        Robots that obstacles keep off: whether time waits for them, and why.
    patience : Patience, optional
        Robots that are waited for no longer.
    """
    codes, texts = _find_statuses(progress, names, wanted, ended, inputs, gates)
    for row, (waits, reason) in obstructed.items():
        codes[row], texts[row] = (Status.WAITING.code if waits else codes[row]), reason
    for reason, rows in _find_held(held).items():
        codes[rows] = Status.HOLDING.code
        texts |= dict.fromkeys(rows, reason)
    if patience is not None:
        texts = patience.announce(texts)
    reasons = _index_reasons(texts, batch)
    if halted is not None and inputs is not None:
        codes[halted] = Status.HOLDING.code
        found = inputs.reasons(halted.reshape(tuple(batch)))
        reasons |= {index: text or reasons.get(index, "") for index, text in found.items()}
    if patience is not None:
        codes[patience.stands] = Status.STOPPED.code
    return codes, reasons


def _find_held(held: Sequence[tuple[Flags | None, str]]) -> dict[str, list[int]]:
    """Find the robots that stand for each reason."""
    return {
        reason: np.flatnonzero(robots).tolist() for robots, reason in held if robots is not None
    }


def _index_reasons(
    texts: Mapping[int, str], batch: Sequence[int]
) -> dict[tuple[int, ...], str]:
    """Give the reasons of robots by their index in a batch."""
    indices = list(np.ndindex(*batch)) if texts else []
    return {indices[row]: text for row, text in texts.items()}


def _find_statuses(
    progress: Sequence[Progress],
    names: Sequence[str],
    wanted: Tensor,
    ended: Flags | None,
    inputs: Inputs | None,
    gates: Gates | None,
) -> tuple[NDArray[np.int8], dict[int, str]]:
    """Find how far robots follow, as far as their joints tell it, and why they do not."""
    codes, texts = _find_waits_at_gates(len(progress), gates)
    rows = [row for row, robot in enumerate(progress) if robot.waits]
    if rows:
        texts |= _explain_waiting(progress, rows, names, wanted, inputs)
    for row in rows:
        displaced = progress[row].probe.displaced
        codes[row] = (Status.DISPLACED if displaced else Status.WAITING).code
    if ended is not None:  # with joints that are somewhere else, a robot has not finished
        codes[ended] = Status.FINISHED.code
        off = [row for row in np.flatnonzero(ended).tolist() if progress[row].lasting]
        codes[off] = Status.WAITING.code
        to = wanted.numpy(force=True).reshape(len(progress), -1)
        texts |= {row: _describe_gap(progress[row], names, to[row]) for row in off}
    return codes, texts


def _find_waits_at_gates(
    count: int, gates: Gates | None
) -> tuple[NDArray[np.int8], dict[int, str]]:
    """Find which robots stand at the end of a skill before another, and why."""
    codes, texts = np.zeros(count, np.int8), dict[int, str]()
    for row, robot in enumerate(() if gates is None else gates.robots):
        if robot.reason:
            texts[row] = robot.reason
            codes[row] = (Status.HOLDING if robot.failed else Status.WAITING).code
    return codes, texts


def _explain_waiting(
    progress: Sequence[Progress],
    rows: Sequence[int],
    names: Sequence[str],
    wanted: Tensor,
    inputs: Inputs | None,
) -> dict[int, str]:
    """Tell for which joint each of some robots is waited."""
    to = wanted.numpy(force=True).reshape(len(progress), -1)
    texts = {row: _describe_gap(progress[row], names, to[row]) for row in rows}
    if inputs is not None:
        frozen = inputs.frozen.reshape(-1)
        texts |= {row: f"{texts[row]}; {FROZEN}" for row in rows if frozen[row]}
    return texts


def _describe_gap(progress: Progress, names: Sequence[str], wanted: Array) -> str:
    """Tell for which joint a robot is waited, and how far it is off."""
    servo = progress.servo
    gap = servo.position - wanted if progress.mode is Mode.HELD else servo.gaps.mean
    joint = int(np.abs(gap).argmax())
    offset = servo.offset.mean[joint]
    return f"joint {names[joint]!r} is {gap[joint]:+.3f} off, beside an offset of {offset:+.3f}"

"""Commands beside measured joints: which actions are postures that servos were sent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Self

import numpy as np

from tpgmm_datasets.conversion.joints import COMMANDED, MEASURED, JointColumns
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.lerobot.columns import ACTION
from tpgmm_datasets.lerobot.layout import Feature, Layout
from tpgmm_datasets.units import Unit
from tpgmm_torch.checks.report import Finding, shorten_list
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.pose_names import quaternion_groups
from tpgmm_torch.motion.command_gaps import FEWEST

DIFFERENCES, VELOCITIES = "differences from step to step", "velocities"
SCALED = "normalised values, or in another unit than the joints"
OTHERS = "no postures of the measured joints"
#: What helps against each of them.
ABSOLUTE = "Record the postures that servos are sent"
REMEDIES = {
    DIFFERENCES: ABSOLUTE,
    VELOCITIES: ABSOLUTE,
    SCALED: "Declare their unit in the set, or convert them",
    OTHERS: "Name actions as the joints that they command",
}
#: Joints that move less tell nothing of their commands, standard deviation [rad or m].
STILL = 0.01
#: How much joints move for a command that moves by one; a lag changes nothing of that.
ALIKE = 0.75, 1.33
#: Share of the variance of joints that commands may be apart from them, squared.
APART = 0.5
#: Correlation of two signals that are one, but for a factor.
CORRELATED = 0.8
#: Rows per second below which a set is not recorded: above that ratio it is velocities [1/s].
FASTEST = 3.0


@dataclass(frozen=True)
class CommandColumns:
    """Where a data set has the commands of joints.

    Parameters
    ----------
    actions : JointColumns
        The feature, with names and units of its values.
    columns : tuple of int or None
        Place of each measured joint among them; None for those without commands.
    """

    actions: JointColumns
    columns: tuple[int | None, ...]

    @classmethod
    def find(cls, layout: Layout, joints: JointColumns) -> Self | None:
        """Find the commands of measured joints; None where the set has none.

        Parameters
        ----------
        layout : Layout
        joints : JointColumns
            The measured joints.
        """
        measured = joints.feature
        key = next((key for key in COMMANDED if key in layout.features), measured.key)
        if key == measured.key or measured.key in COMMANDED:
            return None
        sent = layout.features[key]
        found = _match_values(measured, sent)
        if not found and measured.key not in MEASURED:  # joints that somebody chose
            return None
        units: list[Unit] = ["raw"] * sent.width
        for joint, column in found.items():
            units[column] = _choose_unit(joints, sent, joint, column)
        actions = replace(joints, feature=sent, names=None, units=tuple(units))
        return cls(actions, tuple(found.get(joint) for joint in range(measured.width)))

    def read(
        self, stored: Array, joints: Array, names: Sequence[str] | None
    ) -> tuple[Array | None, str]:
        """Convert actions to commands of all joints; those without stay as they were measured.

        Parameters
        ----------
        stored : array of shape (T, width)
            Actions as the set has them.
        joints : array of shape (T, n_joints)
            The measured joints [rad or m].
        names : sequence of str or None
            Names of the joints.

        Returns
        -------
        As of :func:`keep_postures`.
        """
        if all(column is None for column in self.columns):
            return None, OTHERS
        try:
            values = self.actions.values(stored)
        except DatasetError:  # that cannot be in the unit of the joints
            return None, SCALED
        commands = joints.copy()
        for joint, column in enumerate(self.columns):
            if column is not None:
                commands[:, joint] = values[:, column]
        return keep_postures(commands, joints, names)


def keep_postures(
    commands: Array, joints: Array, names: Sequence[str] | None
) -> tuple[Array | None, str]:
    """Keep commands where they are postures; the parts of quaternions stay as measured.

    Parameters
    ----------
    commands, joints : array of shape (T, n_joints)
        In radians or metres.
    names : sequence of str or None
        Names of the joints.

    Returns
    -------
    commands : array of shape (T, n_joints), or None
        In radians or metres.
    kind : str
        What they are, where they are left out.
    """
    turns = [i for group in quaternion_groups(names) for i in group]
    kept = commands.copy()
    kept[:, turns] = joints[:, turns]
    kind = classify_commands(kept, joints)
    return (None if kind else kept), kind


def _match_values(measured: Feature, sent: Feature) -> dict[int, int]:
    """Find the places of actions that are called as joints, or as many, by the joints'."""
    if measured.names is not None and sent.names is not None:
        pairs = (
            (measured.names.index(n), i)
            for i, n in enumerate(sent.names)
            if n in measured.names
        )
        return dict(pairs)
    alike = measured.width == sent.width and measured.key in MEASURED
    return {i: i for i in range(measured.width)} if alike else {}


def _choose_unit(joints: JointColumns, sent: Feature, joint: int, column: int) -> Unit:
    """Choose the unit of an action: that of the joint, unless the set declares another."""
    declared = joints.feature.units and joints.feature.units[joint]
    own = sent.units and sent.units[column]
    return own if own and own != declared else joints.units[joint]


def classify_commands(commands: Array, joints: Array) -> str:
    """Tell what commands are that are no postures of the joints; empty if they are.

    A command belongs to the joints of the next row, or of its own. Of episodes that are too
    short to learn gaps from, nothing is told.

    Parameters
    ----------
    commands, joints : array of shape (T, n_joints)
        In radians or metres.

    Examples
    --------
    >>> joints = np.sin(np.arange(0, 4, 0.1))[:, None]
    >>> classify_commands(joints + 0.05, joints)
    ''
    >>> classify_commands(np.gradient(joints, axis=0), joints)
    'differences from step to step'
    """
    moved = (joints.std(0) > STILL) & (commands != joints).any(0)
    if len(joints) < FEWEST or not moved.any():
        return ""
    commands, joints = commands[:, moved], joints[:, moved]
    if any(_agree(*rows) for rows in ((commands[:-1], joints[1:]), (commands, joints))):
        return ""
    factor, differ = _compare(commands[:-1], np.diff(joints, axis=0))
    _, alike = _compare(commands, joints)
    if differ > max(alike, CORRELATED):
        return DIFFERENCES if factor < FASTEST else VELOCITIES
    return SCALED if alike > CORRELATED else OTHERS


def _agree(sent: Array, joints: Array) -> bool:
    """Check that joints (T, n_joints) go where they are sent, but for offsets and lags."""
    slope, _ = _compare(sent, joints)
    apart = np.median(((sent - joints) ** 2).mean(0) / joints.var(0))
    return bool(ALIKE[0] < slope < ALIKE[1] and apart < APART)


def _compare(sent: Array, moved: Array) -> tuple[float, float]:
    """Compute medians over joints of slope and correlation of two signals (T, n_joints)."""
    one, other = sent - sent.mean(0), moved - moved.mean(0)
    common = (one * other).mean(0)
    spread = np.sqrt((one**2).mean(0) * (other**2).mean(0))
    correlation = common / np.maximum(spread, np.finfo(float).tiny)
    slope = common / np.maximum((other**2).mean(0), np.finfo(float).tiny)
    return float(np.median(slope)), float(np.median(correlation))


def report_left_out(left_out: Sequence[tuple[int, str]], column: str = ACTION) -> list[Finding]:
    """Report commands that are not learned from, all of one kind together.

    Parameters
    ----------
    left_out : sequence of (int, str)
        Episode and kind.
    column : str, default="action"
        Where they are.
    """
    findings = []
    for kind, places in groupby(sorted(left_out, key=lambda one: one[1]), lambda one: one[1]):
        episodes = tuple(sorted(episode for episode, _ in places))
        message = f"{column!r} holds {kind}: left out in episodes"
        said = f"{message} {shorten_list(list(map(str, episodes)))}"
        remedy = f"{REMEDIES[kind]}; without commands, servos are learned while the robot runs"
        findings.append(Finding("commands", said, remedy, (column,), episodes))
    return findings

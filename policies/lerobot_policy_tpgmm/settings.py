"""Groups of a policy's settings: learning, fusion, control, training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tpgmm_control.loop.clock import Clock
from tpgmm_control.sensing.pose_filter import OneEuro
from tpgmm_control.sensing.trust import Trust
from tpgmm_datasets.conversion.joints import OLD_WORDS
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, Fusion, InformationFusion
from tpgmm_torch.structure.choices import ALIGNMENTS

__all__ = ["ControlConfig", "EMConfig", "FusionConfig"]

#: Bounds for all joints, for each, or for some by name.
Bound = dict[str, float] | list[float] | float | None


def check_choice(name: str, value: Any, choices: tuple[str | None, ...]) -> None:
    """Refuse a ``value`` that is not among the ``choices`` of a setting.

    Raises
    ------
    DataError
    """
    if value not in choices:
        raise DataError(f"{name} is one of {list(choices)}, got {value!r}")


@dataclass
class EMConfig:
    """Learning of the mixture, ``--policy.em.tol=1e-4``.

    Parameters
    ----------
    covariance_type, reg_covar, covariance_shrinkage, tol, max_iter, n_init, init_params, \
    responsibilities, random_state, dtype
        As for :class:`tpgmm_torch.TaskParameterizedGMM`.
    """

    covariance_type: str = "full"
    reg_covar: float = 1e-5
    covariance_shrinkage: float | str = "auto"
    tol: float = 1e-3
    max_iter: int = 100
    n_init: int = 1
    init_params: str = "time"
    responsibilities: str = "auto"
    random_state: int | None = None
    dtype: str = "float64"


@dataclass
class FusionConfig:
    """The product of the operators' Gaussians, ``--policy.fusion.form=covariance``.

    Parameters
    ----------
    form : {"information", "covariance"}, default="information"
    prior_std, priorities, negligible
        Of :class:`tpgmm_torch.regression.fusion_forms.InformationFusion`.
    epsilon, activation
        Of :class:`tpgmm_torch.regression.fusion_forms.CovarianceFusion`.
    """

    form: str = "information"
    prior_std: dict[str, float] | list[float] | float = 10.0
    priorities: list[int] | None = None
    negligible: float = 1e-9
    epsilon: float = 1e-4
    activation: str = "time"

    @classmethod
    def from_fusion(cls, fusion: Fusion) -> FusionConfig:
        """Return the settings of a form of fusion."""
        if isinstance(fusion, CovarianceFusion):
            return cls("covariance", epsilon=fusion.epsilon, activation=fusion.activation)
        priorities = None if fusion.priorities is None else list(fusion.priorities)
        prior_std: Any = fusion.prior_std
        if isinstance(prior_std, Mapping):
            prior_std = dict(prior_std)
        elif isinstance(prior_std, Sequence):
            prior_std = list(prior_std)
        return cls("information", prior_std, priorities, fusion.negligible)

    def value(self) -> Fusion:
        """Return the form of fusion.

        Raises
        ------
        DataError
            If there is no such form.
        """
        check_choice("fusion.form", self.form, ("information", "covariance"))
        if self.form == "covariance":
            return CovarianceFusion(self.epsilon, self.activation)
        return InformationFusion(self.prior_std, self.priorities, self.negligible)


@dataclass
class ControlConfig:
    """Running a skill, ``--policy.control.clock=even``.

    Parameters
    ----------
    clock : str, default="localizing:initial=anywhere"
        How time goes on, as :meth:`tpgmm_control.Clock.parse` takes it:
        ``"even"``, ``"waiting"`` or ``"localizing"``, with options. By default an episode may
        begin in the middle of the skill.
    smoothing : float or None, default=0.5
        Cutoff frequency of the filter on observed poses of objects at rest [Hz]; null for none.
    joint_timeout, frame_timeout : float, default=0.2, 1.0
        How long a robot goes on with the last accepted joints and frames, before it stands [s].
    velocity, acceleration, jerk : float, list of float or dict, optional
        Bounds that are tighter than those of the robot and of the demonstrations [rad/s^n].
    keep_limits : bool, default=True
        Whether references stay within the bounds of motion.
    blend : float, default=1.0
        How long the difference between start posture and model fades [s].
    feedback : {"reference", "observation"}, default="reference"
        What q_{t-1} is: the last reference (as in the paper), or the measured posture.
    largest_start_gap : float or None, default=1.0
        Refuse to begin if a joint stands further from its first reference [rad]: the order
        or the unit is wrong then, or the robot does not stand where the skill begins.
    follow_frames : bool, default=True
        Read the frames at every step, instead of at the start of an episode alone.
    closed_loop : bool, default=True
        Read the joints at every step: the clock uses them, and a robot stands whose joints are
        not accepted. Else a skill is played as it was at the start.
    """

    clock: str = "localizing:initial=anywhere"
    smoothing: float | None = 0.5
    joint_timeout: float = 0.2
    frame_timeout: float = 1.0
    velocity: Bound = None
    acceleration: Bound = None
    jerk: Bound = None
    keep_limits: bool = True
    blend: float = 1.0
    feedback: str = "reference"
    largest_start_gap: float | None = 1.0
    follow_frames: bool = True
    closed_loop: bool = True

    def options(self) -> dict[str, Any]:
        """Return the options of :class:`tpgmm_control.Controller`.

        Raises
        ------
        DataError
            If a setting is out of range.
        """
        check_choice("control.feedback", self.feedback, ("reference", "observation"))
        limits = {name: getattr(self, name) for name in ("velocity", "acceleration", "jerk")}
        bounds = {name: limit for name, limit in limits.items() if limit is not None}
        return {
            "clock": Clock.parse(self.clock),
            "trust": Trust(joint_timeout=self.joint_timeout, frame_timeout=self.frame_timeout),
            "smoothing": None if self.smoothing is None else OneEuro(cutoff=self.smoothing),
            "feedback": "measured" if self.feedback == "observation" else "reference",
            "bounds": (bounds or "robot") if self.keep_limits else None,
            "blend": self.blend,
        }


@dataclass
class TrainingConfig:
    """Training by ``lerobot-train``, ``--policy.training.alignment=linear``.

    Parameters
    ----------
    alignment : {"dtw", "barycenter", "linear", "events", "events+dtw", "parts", "none"}, \
    default="dtw"
        How episodes are brought onto one clock; ``"events"`` anchors them at all events,
        ``"events+dtw"`` warps them in between, too; ``"parts"`` stretches each of the parts
        that are found.
    alignment_features : list of str, optional
        Compared by time warping, as for
        :class:`tpgmm_torch.alignment.DynamicTimeWarping`, by default the speed and the places
        of the links and the joints.
    robust : bool, default=True
        Whether episodes that are unlike the others are left out.
    plausibility : {"warn", "error", "ignore"}, default="warn"
        For recordings that are unlikely to be what they are taken for.
    link_frames : dict of str to str, optional
        Frames that are taken from a link at an event, ``{"bottle": "r_hand@close"}``:
        ``LINK@EVENT`` as for :func:`tpgmm_datasets.load_lerobot`. When it runs, the policy
        reads them like any frame, but for those at ``start``: they follow from the joints.
    events : dict of str to str, optional
        How events are found, ``{"close": "closing:*gripper*"}``, as
        :func:`tpgmm_datasets.events.parse_event` takes it. Others are those of the columns
        ``event.*`` of the data set; ``close``, ``open`` and ``stop`` of a link at which a
        frame is are found by themselves, where there is no such column.
    loss, optimizer_lr, learn_from : optional
        Of policies saved by release 0.3, for steps by gradient and a choice of joints that are
        no more.
    """

    alignment: str = "dtw"
    alignment_features: list[str] | None = None
    robust: bool = True
    plausibility: str = "warn"
    link_frames: dict[str, str] = field(default_factory=dict)
    events: dict[str, str] = field(default_factory=dict)
    loss: str | None = None
    optimizer_lr: float | None = None
    learn_from: str | None = None

    def clear_removed_options(self) -> list[str]:
        """Forget options of release 0.3 that have no effect; return those that were given."""
        names = [name for name in ("loss", "optimizer_lr") if getattr(self, name) is not None]
        self.loss = self.optimizer_lr = None
        return [f"--policy.training.{name}" for name in names]

    def check(self) -> None:
        """Refuse settings that do not exist or do not go together.

        Raises
        ------
        DataError
        """
        check_choice("training.alignment", self.alignment, ALIGNMENTS)
        check_choice("training.learn_from", self.learn_from, (None, *OLD_WORDS))
        check_choice("training.plausibility", self.plausibility, ("warn", "error", "ignore"))

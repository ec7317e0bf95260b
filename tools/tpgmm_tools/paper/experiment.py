"""The paper's experiment (section IV) from end to end: what ``tpgmm demo`` runs.

Generate demonstrations, store them as a LeRobot data set and read them back, align them, learn
them, reproduce the skill for bottle poses and start postures never seen, measure, and draw the
paper's figures.
"""

from __future__ import annotations

import json
import math
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_control import rollout
from tpgmm_datasets.bottle.skill import HANDS, SHOULDERS, TASK, BottleShaking, bottle_operators
from tpgmm_datasets.reader import load_lerobot
from tpgmm_datasets.writer import save_lerobot
from tpgmm_tools.paper.figures import draw_figures
from tpgmm_tools.paper.sinusoid import sinusoid
from tpgmm_torch import Demonstration, Frame, Hold, Situation, TaskParameterizedGMM, save
from tpgmm_torch.alignment import DynamicTimeWarping, LinearTimeNormalization
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.metrics import largest_acceleration, largest_velocity
from tpgmm_torch.regression.fusion_forms import CovarianceFusion
from tpgmm_torch.training.hold_detection import with_holds

__all__ = ["BottleExperiment"]

#: Regularisers of the covariance form that are compared with the information form [rad^2].
EPSILONS = (1e-6, 1e-4, 1e-2)


def _say_nothing(text: str) -> None:
    """Report to nobody."""


@dataclass
class BottleExperiment:
    """One run of the experiment.

    Parameters
    ----------
    out : Path
        Directory for the data set, the model, the figures and ``metrics.json``.
    n_components : int, default=30
        K of the model.
    n_demonstrations : int, default=10
        Generated, to learn from.
    n_situations : int, default=50
        Unseen bottle poses and start postures.
    seed : int, default=0
        Of the demonstrations; the situations take ``seed + 1000``.
    report : callable
        ``report(text)`` is called at the beginning of every stage.
    skill : BottleShaking
        The generator.
    """

    #: How many times :meth:`run` reports.
    STAGES = 13

    out: Path
    n_components: int = 30
    n_demonstrations: int = 10
    n_situations: int = 50
    seed: int = 0
    report: Callable[[str], None] = _say_nothing
    skill: BottleShaking = field(default_factory=BottleShaking)

    def run(self) -> dict[str, Any]:
        """Run everything.

        Returns
        -------
        dict
            What ``metrics.json`` holds.
        """
        began = time.perf_counter()
        self.out.mkdir(parents=True, exist_ok=True)
        self.report("generating demonstrations")
        generated = self.skill.demonstrations(self.n_demonstrations, self.seed)
        self.report("writing and reading the LeRobot data set")
        demonstrations = self._through_files(generated)
        self.report("aligning")
        # how the joints move tells the phase of this skill, not where: postures differ
        warping = DynamicTimeWarping(features=["directions"]).fit(demonstrations)
        aligned = warping.transform(demonstrations)
        measure = _Measure(self.skill, aligned)
        situations = self.skill.situations(self.n_situations, self.seed + 1000)

        self.report(f"learning, K = {self.n_components}")
        held = with_holds(aligned, [Hold("bottle", HANDS[0], measure.spans["reach"][1])])
        model = self._model(self.n_components).fit(held)
        save(model, self.out / "model")
        self.report(f"reproducing, K = {self.n_components}")
        reproductions = _run(model.skill, situations, candidates=True)
        results = {f"information form, K = {self.n_components}": reproductions}
        self.report("learning and reproducing, K = 10")
        smaller = self._model(10).fit(aligned).skill
        results["information form, K = 10"] = _run(smaller, situations)
        for epsilon in EPSILONS:
            name = f"covariance form, epsilon = {epsilon:g}"
            self.report(f"reproducing, {name}")
            printed = replace(model.skill, fusion=CovarianceFusion(epsilon))
            results[name] = _run(printed, situations)
        self.report("learning and reproducing without orientation")
        position_only = self._model(self.n_components, orientation=False).fit(aligned)
        results["position only"] = ablated = _run(position_only.skill, situations)
        self.report("learning and reproducing without time warping")
        linear = LinearTimeNormalization().fit(demonstrations)
        scaled = linear.transform(demonstrations)
        others = _run(self._model(self.n_components).fit(scaled).skill, situations)
        alignment = {
            "time warping": measure.alignment(demonstrations, warping.paths_, reproductions),
            "linear": _Measure(self.skill, scaled).alignment(
                demonstrations, linear.paths_, others
            ),
        }
        self.report("drawing")
        draw_figures(
            self.out, model, aligned, reproductions[0], ablated[0], situations[0], measure.spans
        )
        self.report("writing metrics.json")
        metrics = {
            "settings": self._settings(),
            "rows": {name: measure(found, situations) for name, found in results.items()},
            "share of information on the shoulders": measure.shares(reproductions),
            "alignment": alignment,
            "demonstrations": measure.demonstrations(demonstrations),
            "seconds": time.perf_counter() - began,
        }
        (self.out / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n")
        return metrics

    def _through_files(self, demonstrations: Sequence[Demonstration]) -> list[Demonstration]:
        path = self.out / "dataset"
        if (path / "meta" / "info.json").is_file():
            shutil.rmtree(path)
        rate = round(self.skill.rate)
        save_lerobot(demonstrations, path, fps=rate, task=TASK, robot_type="upper_body")
        return load_lerobot(
            path, robot=self.skill.robot, frames={"bottle": "observation.environment_state"}
        )

    def _model(self, n_components: int, orientation: bool = True) -> TaskParameterizedGMM:
        operators = bottle_operators(orientation)
        return TaskParameterizedGMM(n_components, operators, self.skill.robot)

    def _settings(self) -> dict[str, Any]:
        own = ("n_components", "n_demonstrations", "n_situations", "seed")
        packages = ("tpgmm-torch", "torch", "numpy", "scikit-learn")
        return {name: getattr(self, name) for name in own} | {
            "threads": torch.get_num_threads(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "versions": {name: version(name) for name in packages},
        }


def _run(
    skill: Any, situations: Sequence[Situation], candidates: bool = False
) -> list[Trajectory]:
    """Reproduce within the robot's bounds, faded in from the start posture."""
    return rollout(skill, situations, bounds="robot", blend=1.0, candidates=candidates)


class _Measure:
    """Figures of merit, against aligned demonstrations."""

    def __init__(self, skill: BottleShaking, aligned: Sequence[Demonstration]) -> None:
        self.skill, self.aligned, self.time = skill, aligned, aligned[0].time
        events = [[one.events[n] for n in ("grasp", "shake", "rest")] for one in aligned]
        grasp, shake, rest = np.mean(events, axis=0).tolist()
        self.contact = int(torch.searchsorted(self.time, grasp))
        self.spans = {"reach": (0.0, grasp), "shake": (shake, rest)}
        self.shaking = self._window(shake, rest)
        # the first and the last eighth of the shaking grow and fade
        fade = (rest - shake) / 8
        self.steady = self._window(shake + fade, rest - fade)
        self.grasping = self._window(grasp - 2.0, grasp)
        self.shoulders = self._shoulders(aligned).mean(0)

    def _shoulders(self, motions: Sequence[Trajectory | Demonstration]) -> Tensor:
        return torch.stack([self.skill.shoulders(motion) for motion in motions])

    def _window(self, start: float, end: float) -> Tensor:
        return (self.time >= start) & (self.time <= end)

    def __call__(
        self, trajectories: Sequence[Trajectory], situations: Sequence[Situation]
    ) -> dict[str, Any]:
        """Compute median and 95th percentile over situations; the worst where limits count."""
        joints = torch.stack([trajectory.joints for trajectory in trajectories])
        starts = torch.stack([situation.joints for situation in situations])
        bottles = Frame.stack([situation.frames["bottle"] for situation in situations])
        grasps = self._grasps(joints[:, self.contact], bottles)
        shoulders = self._shoulders(trajectories)
        residual = (shoulders - self.shoulders)[:, self.shaking]
        wanted = self._rhythm(self.shoulders)
        rhythms = np.array([self._rhythm(motion) for motion in shoulders]) / wanted - 1
        robot = self.skill.robot
        beyond = torch.maximum(robot.lower - joints, joints - robot.upper).clamp(min=0)
        return (
            grasps
            | {
                "shoulder RMSE [rad]": _spread(residual.square().mean((1, 2)).sqrt()),
                "frequency error [%]": _spread(100 * np.abs(rhythms[:, 0])),
                "amplitude error [%]": _spread(100 * np.abs(rhythms[:, 1])),
                "first step [rad]": float((joints[:, 0] - starts).abs().max()),
                "beyond joint limits [rad]": float(beyond.max()),
            }
            | _pace(trajectories)
        )

    def _rhythm(self, shoulders: Tensor) -> NDArray[np.float64]:
        """Fit frequency and amplitude, the mean of both shoulders."""
        fits = [sinusoid(self.time[self.steady], side[self.steady]) for side in shoulders.T]
        return np.mean([(fit.frequency, fit.amplitude) for fit in fits], axis=0)

    def shares(self, trajectories: Sequence[Trajectory]) -> dict[str, float]:
        """Compute figure 6 in two numbers: who determines the shoulders, and when."""
        columns = [self.skill.robot.joint_names.index(name) for name in SHOULDERS]
        shares = [torch.stack([t.candidates[j].share for t in trajectories]) for j in (0, 1)]
        task, canonical = (share[..., columns].mean((0, -1)) for share in shares)
        return {
            "task operator, two seconds before the grasp": float(task[self.grasping].mean()),
            "canonical operator, while shaking": float(canonical[self.steady].mean()),
        }

    def alignment(
        self,
        demonstrations: Sequence[Demonstration],
        paths: Sequence[NDArray[np.float64]],
        trajectories: Sequence[Trajectory],
    ) -> dict[str, float]:
        """Measure how unlike the demonstrations shake, and the reproductions from each of them.

        The true phase of a demonstration is known from its events, and ``paths`` are its
        instants at each time of the common clock [s].
        """
        phases = []
        for demonstration, path in zip(demonstrations, paths, strict=True):
            shake, rest = (demonstration.events[name] for name in ("shake", "rest"))
            done = ((torch.from_numpy(path) - shake) / (rest - shake)).clamp(0, 1)
            phases.append(2 * math.pi * self.skill.cycles * done)
        spread = torch.stack(phases)[:, self.steady].std(0)
        apart = self._shoulders(trajectories)[None] - self._shoulders(self.aligned)[:, None]
        rmse = apart[:, :, self.shaking].square().mean().sqrt()
        return {
            "spread of the shaking's phase [rad]": float(spread.square().mean().sqrt()),
            "shoulder RMSE against each demonstration [rad]": float(rmse),
        }

    def demonstrations(self, demonstrations: Sequence[Demonstration]) -> dict[str, Any]:
        """Measure errors of the demonstrations themselves, before alignment."""
        contacts = [
            d.joints[int(torch.searchsorted(d.time, d.events["grasp"]))] for d in demonstrations
        ]
        bottles = Frame.stack([d.frames["bottle"] for d in demonstrations])
        durations = [d.duration for d in demonstrations]
        found = {"duration [s]": [min(durations), max(durations)]}
        return found | self._grasps(torch.stack(contacts), bottles) | _pace(demonstrations)

    def _grasps(self, joints: Tensor, bottles: Frame) -> dict[str, Any]:
        position, orientation = self.skill.grasp_error(joints, bottles)
        return {
            "grasp position error [mm]": _spread(1e3 * position),
            "grasp orientation error [deg]": _spread(torch.rad2deg(orientation)),
        }


def _pace(motions: Sequence[Trajectory | Demonstration]) -> dict[str, Any]:
    return {
        "joint speed [rad/s]": _spread([largest_velocity(one) for one in motions]),
        "joint acceleration [rad/s^2]": _spread([largest_acceleration(one) for one in motions]),
    }


def _spread(values: Any) -> dict[str, float]:
    found = np.percentile(np.asarray(values, dtype=np.float64), (50, 95, 100))
    return dict(zip(("median", "p95", "max"), found.tolist(), strict=True))

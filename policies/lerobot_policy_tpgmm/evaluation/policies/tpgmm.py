"""TP-GMM as one of the policies that are compared."""

from __future__ import annotations

from pathlib import Path

from lerobot_policy_tpgmm.evaluation.benchmarks import Benchmark
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tpgmm_datasets import load_lerobot
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

__all__ = ["fit_tpgmm"]


def fit_tpgmm(
    benchmark: Benchmark,
    dataset: Path,
    n: int,
    seed: int,
    n_components: int | None = None,
    orientation: bool = True,
) -> TPGMMPolicy:
    """Align the first episodes of a data set and learn their references.

    Parameters
    ----------
    dataset : Path
        A LeRobot data set.
    n : int
        How many episodes.
    seed : int
        Of the model.
    n_components : int, optional
        K; the default is the benchmark's.
    orientation : bool, default=True
        Whether the orientation of the hands is learned in the objects' frames.

    Returns
    -------
    TPGMMPolicy
    """
    demonstrations = load_lerobot(
        dataset, robot=benchmark.robot, joints="action", episodes=range(n)
    )
    if not benchmark.synchronous:
        warping = DynamicTimeWarping(features=["directions"])
        demonstrations = warping.fit_transform(demonstrations)
    model = TaskParameterizedGMM(
        n_components or benchmark.n_components,
        benchmark.operators(orientation),
        benchmark.robot,
        random_state=seed,
    )
    return TPGMMPolicy.from_estimator(model.fit(demonstrations), fps=benchmark.rate)

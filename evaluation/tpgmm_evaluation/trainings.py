"""How each policy of the comparison is trained on the first episodes of a set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from lerobot.processor import make_default_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from tpgmm_datasets import describe_lerobot, drop_outliers, load_lerobot
from tpgmm_evaluation.baselines import RECIPES, Training, train
from tpgmm_evaluation.benchmarks import Benchmark
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_evaluation.policies.episodes import Episodes
from tpgmm_evaluation.policies.planned import SituatedPolicy
from tpgmm_evaluation.policies.replay import NearestPolicy
from tpgmm_evaluation.policies.situated import KeyPosesPolicy, MeanPolicy
from tpgmm_evaluation.settings import Settings
from tpgmm_torch import Canonical, Demonstration, TaskParameterizedGMM, attach_holds
from tpgmm_torch.alignment import DynamicTimeWarping
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.text import format_operator
from tpgmm_torch.structure.select_operators import SelectOperators

#: TP-GMM with one of its parts removed, or with its operators chosen by itself.
ABLATIONS = ("tpgmm-places", "tpgmm-position-only", "tpgmm-no-joints", "tpgmm-auto")


def _tpgmm(episodes: Path, settings: Settings, cell: Cell) -> Training:
    """Align the first episodes and learn their references."""
    benchmark = settings.benchmark()
    demonstrations = load_lerobot(
        episodes / "training",
        robot=benchmark.robot,
        joints="action",
        episodes=range(cell.demonstrations),
    )
    base = cell.variant.base
    if base == "tpgmm-places":
        demonstrations = [_at_first(demonstration) for demonstration in demonstrations]
    if not benchmark.synchronous:
        warping = DynamicTimeWarping(robot=benchmark.robot)
        demonstrations = warping.fit_transform(demonstrations)
    robot = benchmark.robot
    operators = (
        SelectOperators(robot=robot).fit(attach_holds(demonstrations, robot)).operators_
        if base == "tpgmm-auto"
        else operators_of(base, benchmark)
    )
    n_components = settings.n_components or benchmark.n_components
    model = TaskParameterizedGMM(n_components, operators, robot, random_state=cell.seed)
    kept = drop_outliers(demonstrations, operators, robot)
    policy = TPGMMPolicy.from_estimator(
        model.fit(attach_holds(kept, robot)),
        fps=benchmark.rate,
        environment_names=_environment_names(episodes / "training"),
    )
    recipe = {
        "n_components": model.n_components,
        "operators": list(map(format_operator, model.operators_)),
    }
    processors = make_tpgmm_pre_post_processors(policy.config)
    outcome = "learned by expectation-maximisation"
    return Training(policy, processors, benchmark.rate, recipe, outcome=outcome)


def operators_of(base: str, benchmark: Benchmark) -> list[Operator]:
    """Choose the operators of TP-GMM when one of its parts is removed.

    Parameters
    ----------
    base : str
        ``"tpgmm"`` or an ablation.
    benchmark : Benchmark
        The environment with its robot.
    """
    operators = benchmark.operators(
        orientation=base != "tpgmm-position-only", held=base != "tpgmm-places"
    )
    if base != "tpgmm-no-joints":
        return operators
    # a gripper moves no link: nothing but its own coordinate can tell of it
    robot = benchmark.robot
    moved = robot.state(robot.lower.clamp(-1, 1)).jacobians.abs().sum((0, 1)) > 0
    free = [name for name, moves in zip(robot.joint_names, moved, strict=True) if not moves]
    rest: list[Operator] = [part for part in operators if not part.is_posture]
    return [*rest, Canonical(joints=tuple(free))] if free else rest


def _environment_names(path: Path) -> list[str]:
    """Name the entries of the observation: operators may have objects in another order."""
    columns = {column.key: column.names for column in describe_lerobot(path).columns}
    return list(columns[OBS_ENV_STATE] or ())


def _at_first(demonstration: Demonstration) -> Demonstration:
    """Put all objects where they were at the beginning."""
    frames = {
        name: frame[0] if frame.batch_shape else frame
        for name, frame in demonstration.frames.items()
    }
    return replace(demonstration, frames=frames)


def _baseline(episodes: Path, settings: Settings, cell: Cell) -> Training:
    training = Episodes.read(episodes / "training").first(cell.demonstrations)
    validation = Episodes.read(episodes / "validation")
    recipe = RECIPES[cell.variant.base]
    if recipe.phase and not settings.benchmark().synchronous:
        training, validation = training.on_common_clock(validation)
    return train(recipe, training, validation, seed=cell.seed, budget=settings.budget)


def _nearest(episodes: Path, settings: Settings, cell: Cell) -> Training:
    kept = Episodes.read(episodes / "training").first(cell.demonstrations)
    policy = NearestPolicy.fit(kept)
    processors = make_default_pre_post_processors(policy.config)
    return Training(policy, processors, kept.fps, outcome="kept as they are")


def _fit_plan(
    episodes: Path, settings: Settings, cell: Cell, kind: type[SituatedPolicy], **options: Any
) -> Training:
    """Fit what plans in joints to the aligned references."""
    benchmark = settings.benchmark()
    aligned = Aligned.read(
        episodes / "training", benchmark.robot, cell.demonstrations, benchmark.synchronous
    )
    policy = kind.fit(aligned, **options)
    processors = make_default_pre_post_processors(policy.config)
    recipe = {"policy": kind.name, **policy.recipe()}
    return Training(policy, processors, aligned.fps, recipe, outcome="fitted at once")


#: In the order of the report.
TRAININGS: dict[str, Callable[[Path, Settings, Cell], Training]] = {
    "tpgmm": _tpgmm,
    **dict.fromkeys(ABLATIONS, _tpgmm),
    "key-poses": partial(_fit_plan, kind=KeyPosesPolicy),
    "key-poses-posture": partial(_fit_plan, kind=KeyPosesPolicy, posture=True),
    **dict.fromkeys(RECIPES, _baseline),
    "nearest": _nearest,
    "mean": partial(_fit_plan, kind=MeanPolicy),
}

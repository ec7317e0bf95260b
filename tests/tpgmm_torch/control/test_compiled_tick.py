"""The compiled tick against the plain one."""

import pickle
import shutil
from typing import Any

import pytest
import torch

from tests.support.worlds import OBJECT
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Situation,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.control.compiled_tick import PART
from tpgmm_torch.exceptions import DataError, DependencyError, NotFittedError, ShapeError

# most ticks are nowhere near what the few demonstrations show: they are to be equal, not right
pytestmark = pytest.mark.filterwarnings(
    "ignore:the (first tick|situation):tpgmm_torch.exceptions.PlausibilityWarning"
)

URDF = """<robot name="two"><link name="base"/><link name="upper"/><link name="lower"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="3" effort="1"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="3" effort="1"/>
</joint></robot>"""


def fitted(
    dtype: str = "float64", robot: bool = True, parts: bool = False, **options: Any
) -> TaskParameterizedGMM:
    """Two joints that reach for a cup, or two joints and nothing else, in one part or two."""
    arm = Robot.from_urdf(URDF, ["hand"], tools={"hand": ("lower", [0.2, 0, 0])})
    time = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    demonstrations = []
    for gap in torch.linspace(-0.2, 0.2, 5, dtype=torch.float64):
        joints = torch.cat((time + gap * (1 - time), 0.5 + 0.3 * time**2), 1)
        hand = arm.state(joints[-1])
        cup = Frame(hand.position("hand"), hand.orientation("hand"))
        demonstrations.append(Demonstration(time[:, 0], joints, {OBJECT: cup}))
    operators = [Canonical()]
    if robot:
        task = RelativePosition("hand", OBJECT), RelativeOrientation("hand", OBJECT)
        operators = [Stack(*task), Canonical()]
    if parts:  # the cup does not matter in the first
        options |= {"parts": [0.5], "n_components": 4}
        operators = [[Canonical()], operators]
    settings = {"n_components": 3, "operators": operators, "dtype": dtype, **options}
    return TaskParameterizedGMM(robot=arm if robot else None, **settings).fit(demonstrations)


def cup(*batch: int) -> dict[str, Frame]:
    position = torch.tensor([0.3, 0.35, 0.0], dtype=torch.float64).expand(*batch, 3)
    return {OBJECT: Frame(position)}


def assert_same(actual, expected, atol=1e-9):
    for name in ("joints", "covariance", "activation"):
        torch.testing.assert_close(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=atol
        )


def test_ticks_and_whole_motions_are_the_same():
    plain, compiled = fitted(), fitted().compile("aot_eager")
    for time in (0.0, 0.31, 0.9, 5.0):
        assert_same(compiled.step(time, [0.2, 0.5], cup()), plain.step(time, [0.2, 0.5], cup()))
    many = torch.rand(3, 2, dtype=torch.float64)
    for frames in (cup(), cup(3)):
        assert_same(compiled.step(0.4, many, frames), plain.step(0.4, many, frames))
    situation = Situation([0.1, 0.4], cup())
    for candidates in (False, True):
        [actual] = compiled.predict([situation], candidates=candidates)
        [expected] = plain.predict([situation], candidates=candidates)
        torch.testing.assert_close(actual.joints, expected.joints, rtol=0, atol=1e-9)
        assert len(actual.candidates) == len(expected.candidates)


def test_what_the_graph_does_not_serve_runs_as_before():
    plain, compiled = fitted(), fitted().compile("aot_eager")
    times = torch.tensor([0.1, 0.7], dtype=torch.float64)
    joints = torch.rand(2, 2, dtype=torch.float64)
    assert_same(compiled.step(times, joints, cup()), plain.step(times, joints, cup()))
    state = plain.kinematics_.state(joints)
    assert_same(compiled.step(0.3, state, cup()), plain.step(0.3, state, cup()))
    wanted = joints.clone().requires_grad_()
    compiled.step(0.3, wanted, cup()).joints.sum().backward()
    assert wanted.grad is not None
    assert bool(wanted.grad.isfinite().all())


def test_a_compiled_model_is_stored_and_fitted_again_like_any_other(tmp_path):
    model = fitted().compile("aot_eager")
    expected = model.step(0.5, [0.2, 0.5], cup())
    assert_same(pickle.loads(pickle.dumps(model)).step(0.5, [0.2, 0.5], cup()), expected)
    model.save(tmp_path / "model")
    loaded = TaskParameterizedGMM.load(tmp_path / "model")
    assert_same(loaded.step(0.5, [0.2, 0.5], cup()), expected)
    model.set_params(negligible=1e-3)
    assert_same(model.step(0.5, [0.2, 0.5], cup()), expected, atol=1e-2)


def test_bad_input_is_refused_as_before():
    model = fitted().compile("aot_eager")
    with pytest.raises(DataError, match="NaN"):
        model.step(0.5, [0.2, float("nan")], cup())
    with pytest.raises(KeyError, match=OBJECT):
        model.step(0.5, [0.2, 0.5])


def test_models_without_a_task_are_refused_and_stay_as_they_are():
    model = fitted(robot=False)
    with pytest.raises(DataError, match=r"compile\(\) serves .*JointSpace.*use it as it is"):
        model.compile("aot_eager")
    assert model.step(0.5, [0.2, 0.5]).joints.shape == (2,)
    with pytest.raises(NotFittedError):
        TaskParameterizedGMM().compile("aot_eager")


def test_without_a_compiler_there_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(DependencyError, match=r"needs a C\+\+ compiler"):
        fitted().compile()


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_graphs_of_the_default_backend():
    plain, compiled = fitted(), fitted().compile()
    with torch.inference_mode():
        for time in (0.0, 0.45, 1.0):
            actual = compiled.step(time, [0.2, 0.5], cup())
            assert_same(actual, plain.step(time, [0.2, 0.5], cup()))
    # it asks nothing about strides: rows, columns and repetitions must come as it knows them
    turned = torch.rand(2, PART + 3, dtype=torch.float64).T
    for joints in (turned, turned[::2], turned[:1], turned[0].expand(3, 2)):
        for frames in (cup(), cup(len(joints))):
            assert_same(compiled.step(0.4, joints, frames), plain.step(0.4, joints, frames))
    # nor about types
    single = {OBJECT: Frame(cup()[OBJECT].position.float())}
    now, near = torch.tensor(0.4), compiled.kinematics_.joint_tensor([0.2, 0.5])
    actual = compiled.regression().estimate(now, near.float(), single)
    assert_same(actual, plain.step(0.4, [0.2, 0.5], cup()), atol=1e-7)
    with pytest.raises(ShapeError, match=r"shape \(\.\.\., 2\)"):
        compiled.step(0.4, near[:1], cup())
    assert compiled.step(0.4, turned[:0], cup()).joints.shape == (0, 2)
    grid = turned[:6].reshape(2, 3, 2)
    assert_same(compiled.step(0.4, grid, cup(3)), plain.step(0.4, grid, cup(3)))
    assert len(compiled.regression()._graphs) == 2


def test_more_components_than_the_graph_knows_run_as_before():
    plain, compiled = (fitted().set_params(negligible=1e-2) for _ in range(2))
    compiled.compile("aot_eager")
    regression = compiled.regression()
    assert regression._largest < compiled.n_components
    tables = []
    graph = regression._graphs[torch.Size([1, 2])]
    regression._graphs[torch.Size([1, 2])] = lambda inputs: (
        tables.append(inputs) or graph(inputs)
    )
    for time, served in ((0.4, 1), (50.0, 1), (0.5, 2)):
        assert_same(compiled.step(time, [0.2, 0.5], cup()), plain.step(time, [0.2, 0.5], cup()))
        assert len(tables) == served


def test_a_direction_without_variance_is_an_error_and_no_number():
    model = fitted().compile("aot_eager")
    covariance = model.regression()._update.conditionals.covariance
    covariance[:, :-2, :-2].mul_(-1)
    model.regression()._selected.clear()
    with pytest.raises(DataError, match="covariance of the tasks is not positive definite"):
        model.step(0.5, [0.2, 0.5], cup())


def test_priorities_are_part_of_the_graph():
    soft, plain, compiled = fitted(), fitted(), fitted()
    for model in (plain, compiled):
        model.priorities = [1, 0]
    compiled.compile("aot_eager")
    at = 0.4, [0.2, 0.5], cup()
    assert_same(compiled.step(*at), plain.step(*at))
    assert float((plain.step(*at).joints - soft.step(*at).joints).abs().max()) > 1e-4


def test_parts_are_served():
    plain, compiled = fitted(parts=True), fitted(parts=True).compile("aot_eager")
    assert [part.n_components for part in compiled.parts_] == [2, 2]
    for time in (0.0, 0.31, 0.499, 0.501, 0.9, 5.0):
        assert_same(compiled.step(time, [0.2, 0.5], cup()), plain.step(time, [0.2, 0.5], cup()))
    situation = Situation([0.1, 0.4], cup())
    [actual], [expected] = compiled.predict([situation]), plain.predict([situation])
    torch.testing.assert_close(actual.joints, expected.joints, rtol=0, atol=1e-9)

"""The compiled and the exported estimate against the plain one."""

import pickle
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tests.support.worlds import OBJECT
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Stack,
    TaskParameterizedGMM,
)
from tpgmm_torch.exceptions import DataError, DependencyError, ShapeError, UnknownNameError
from tpgmm_torch.regression.fusion_forms import InformationFusion
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.compiled import PART, compile_skill, export_estimate

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[3] / "examples" / "deployment_cpp"
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
URDF = """<robot name="two"><link name="base"/><link name="upper"/><link name="lower"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="3" effort="1"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="3" effort="1"/>
</joint></robot>"""
CUP = [0.3, 0.35, 0.0]


def fitted(robot: bool = True, **options: Any) -> Regression:
    """Two joints that reach for a cup, or two joints and nothing else."""
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
    settings = {"n_components": 3, "operators": operators, **options}
    model = TaskParameterizedGMM(robot=arm if robot else None, **settings)
    return model.fit(demonstrations).skill


def cup(*batch: int) -> dict[str, Frame]:
    return {OBJECT: Frame(torch.tensor(CUP, dtype=torch.float64).expand(*batch, 3))}


def at(time: float, joints: Any = (0.2, 0.5), frames: Any = None) -> tuple[Any, ...]:
    double = torch.float64
    joints = torch.as_tensor(joints, dtype=double)
    return torch.tensor(time, dtype=double), joints, cup() if frames is None else frames


def assert_same(one, other, *given, atol=1e-9):
    actual, expected = one.estimate(*given), other.estimate(*given)
    for name in ("joints", "covariance", "activation"):
        torch.testing.assert_close(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=atol
        )


@pytest.fixture(scope="module")
def plain():
    return fitted()


@pytest.mark.parametrize("case", [{}, {"fusion": InformationFusion(priorities=[1, 0])}])
def test_estimates_are_the_same(case):
    plain = fitted(**case)
    compiled = compile_skill(plain, backend="aot_eager")
    for time in (0.0, 0.31, 0.499, 0.501, 0.9, 5.0):
        assert_same(compiled, plain, *at(time))
    many = torch.rand(3, 2, dtype=torch.float64)
    for frames in (cup(), cup(3)):
        assert_same(compiled, plain, *at(0.4, many, frames))
    bounds = torch.tensor([-2.0, -2.0]).double(), torch.tensor([0.3, 2.0]).double()
    assert_same(compiled, plain, *at(0.9), bounds)
    assert_same(pickle.loads(pickle.dumps(compiled)), plain, *at(0.4))


def test_other_inputs_are_given_to_the_plain_estimate(plain):
    compiled = compile_skill(plain, backend="aot_eager")
    times = torch.tensor([0.1, 0.7], dtype=torch.float64)
    joints = torch.rand(2, 2, dtype=torch.float64)
    assert_same(compiled, plain, times, joints, cup())
    assert_same(compiled, plain, *at(0.3)[:1], plain.kinematics.state(joints), cup())
    wanted = joints.clone().requires_grad_()
    compiled.estimate(at(0.3)[0], wanted, cup()).joints.sum().backward()
    assert wanted.grad is not None
    assert bool(wanted.grad.isfinite().all())
    refused(lambda: compiled.estimate(*at(0.5, [0.2, float("nan")])), DataError, "NaN")
    refused(lambda: compiled.estimate(*at(0.5, frames={})), UnknownNameError, OBJECT)


def test_more_components_than_the_graph_takes_are_given_to_the_plain_estimate():
    plain = fitted(fusion=InformationFusion(negligible=1e-2))
    compiled = compile_skill(plain, backend="aot_eager")
    for time in (0.4, 50.0, 0.5):
        assert_same(compiled, plain, *at(time))


@pytest.mark.parametrize("function", [compile_skill, export_estimate])
def test_skills_of_another_kind_are_refused(function, tmp_path, plain):
    given = [tmp_path / "out.pt2"] if function is export_estimate else []
    name = function.__name__
    with pytest.raises(DataError, match=rf"{name}\(\) serves .*JointSpace.*use it as it is"):
        function(fitted(robot=False), *given)
    [task, own] = plain.operators
    carried = Stack(RelativePosition("thing", OBJECT), *task.leaves[1:])
    with pytest.raises(DataError, match=rf"{name}\(\) serves"):
        function(replace(plain, operators=[carried, own]), *given)
    assert list(tmp_path.iterdir()) == []


def test_without_a_compiler_there_is_a_clear_error(monkeypatch, plain, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    for function, given in ((compile_skill, []), (export_estimate, [tmp_path / "out.pt2"])):
        with pytest.raises(
            DependencyError, match=rf"{function.__name__}\(\) needs a C\+\+ com"
        ):
            function(plain, *given)


def test_only_double_precision_is_exported(tmp_path):
    single = fitted(dtype="float32")
    with pytest.raises(DataError, match="takes a skill in float64 on the CPU, got "):
        export_estimate(single, tmp_path / "out.pt2")


@needs_compiler
def test_the_graphs_of_the_default_backend(plain):
    compiled = compile_skill(plain)
    with torch.inference_mode():
        for time in (0.0, 0.45, 1.0):
            assert_same(compiled, plain, *at(time))
    # the graph takes strides as given: rows, columns and repetitions must be made contiguous
    turned = torch.rand(2, PART + 3, dtype=torch.float64).T
    for joints in (turned, turned[::2], turned[:1], turned[0].expand(3, 2)):
        for frames in (cup(), cup(len(joints))):
            assert_same(compiled, plain, *at(0.4, joints, frames))
    grid = turned[:6].reshape(2, 3, 2)
    assert_same(compiled, plain, *at(0.4, grid, cup(3)))
    assert compiled.estimate(*at(0.4, turned[:0])).joints.shape == (0, 2)
    # other dtypes are converted
    single = {OBJECT: Frame(cup()[OBJECT].position.float())}
    actual = compiled.estimate(torch.tensor(0.4), torch.tensor([0.2, 0.5]), single).joints
    expected = plain.estimate(*at(0.4)).joints
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-7)
    with pytest.raises(ShapeError, match=r"shape \(\.\.\., 2\)"):
        compiled.estimate(*at(0.4, turned[0, :1]))


@pytest.fixture(scope="module")
def package(plain, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "reach.pt2"
    export_estimate(plain, path)
    assert list(path.parent.iterdir()) == [path]
    return path


@needs_compiler
def test_the_package_gives_the_estimate(package, plain):
    estimate = torch._inductor.aoti_load_package(str(package))
    contents = estimate.loader.get_metadata()
    assert contents["joint_names"] == "turn,bend"
    assert contents["frame_names"] == OBJECT
    assert (float(contents["begin"]), float(contents["end"])) == (plain.begin, plain.end)
    pose = torch.tensor([[*CUP, 2.0, 0.0, 0.0, 0.2]], dtype=torch.float64)
    frames = {OBJECT: Frame(pose[0, :3], pose[0, 3:] / pose[0, 3:].norm())}
    for time in (0.0, 0.31, 1.0):
        now, joints, _ = at(time)
        mean, covariance = estimate(now, joints, pose)
        expected = plain.estimate(now, joints, frames)
        torch.testing.assert_close(mean, expected.joints, rtol=0, atol=1e-9)
        torch.testing.assert_close(covariance, expected.covariance, rtol=0, atol=1e-9)


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_the_example_in_cpp_runs_the_skill(package, plain, tmp_path):
    root = f"-DTORCH_ROOT={Path(torch.__file__).parent}"
    for command in (["-S", EXAMPLE, "-B", tmp_path, root], ["--build", tmp_path]):
        subprocess.run(["cmake", *command], check=True, capture_output=True)
    numbers = [0.2, 0.5, *CUP, 1, 0, 0, 0]
    done = subprocess.run(
        [tmp_path / "estimate_loop", package, "0.05", "30"],
        input=" ".join(map(str, numbers)), capture_output=True, text=True, check=True,
    )  # fmt: skip
    joints = torch.tensor([0.2, 0.5], dtype=torch.float64)
    for tick, line in enumerate(done.stdout.splitlines()):
        estimate = plain.estimate(*at(min(0.05 * tick, 1.0), joints))
        joints = estimate.joints
        expected = [*joints.tolist(), *estimate.covariance.diagonal().tolist()]
        np.testing.assert_allclose(np.array(line.split(), float)[1:], expected, atol=1e-9)
    assert tick == 29
    few = subprocess.run(
        [tmp_path / "estimate_loop", package, "0.05", "30"],
        input="0.2", capture_output=True, text=True,
    )  # fmt: skip
    assert few.returncode == 1
    assert "too few numbers" in few.stderr

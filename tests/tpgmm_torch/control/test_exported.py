"""What was exported against the controller, in Python and in C++."""

import json
import shutil
import subprocess
import zipfile
from dataclasses import fields
from pathlib import Path

import pytest
import torch

from tests.support.worlds import OBJECT
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    LocalizingClock,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Stack,
    Status,
    TaskParameterizedGMM,
    WaitingClock,
    load_exported,
)
from tpgmm_torch.control import exported as exported_module
from tpgmm_torch.control.clocks import parse_clock
from tpgmm_torch.control.compiled_tick import CompiledRegression
from tpgmm_torch.control.exported_tick import BrakingLaw, ExportedTick
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    ModelFileError,
    ShapeError,
    UnknownNameError,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.sensing.trust import Trust

pytestmark = pytest.mark.filterwarnings(
    "ignore:the (first tick|situation):tpgmm_torch.exceptions.PlausibilityWarning"
)
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")

EXAMPLE = Path(__file__).parents[3] / "examples" / "deployment_cpp"
URDF = """<robot name="two"><link name="base"/><link name="upper"/><link name="lower"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="300" acceleration="1200"
deceleration="1200" jerk="48000" effort="1"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="300" acceleration="1200"
deceleration="1200" jerk="48000" effort="1"/>
</joint></robot>"""
START, DT, TICKS = [0.02, 0.51], 0.01, 130


ARM = Robot.from_urdf(URDF, ["hand"], tools={"hand": ("lower", [0.2, 0, 0])})
HAND = ARM.state(torch.tensor([0.3, 0.8], dtype=torch.float64))
CUP = {OBJECT: Frame(HAND.position("hand"), HAND.orientation("hand"))}


@pytest.fixture(scope="module")
def shown():
    """Two joints that reach for a cup."""
    time = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    demonstrations = []
    for gap in torch.linspace(-0.2, 0.2, 5, dtype=torch.float64):
        went = minimum_jerk(time)  # from rest to rest
        joints = torch.cat((0.3 * went + gap * (1 - went), 0.5 + 0.3 * went), 1)
        demonstrations.append(Demonstration(time[:, 0], joints, CUP))
    return demonstrations


@pytest.fixture(scope="module")
def model(shown):
    task = RelativePosition("hand", OBJECT), RelativeOrientation("hand", OBJECT)
    return TaskParameterizedGMM(3, [Stack(*task), Canonical()], ARM, blend=0.3).fit(shown)


@pytest.fixture(scope="module")
def package(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "reach.pt2"
    model.export(path, clock="localizing")
    return path


@pytest.fixture(scope="module")
def expected(model):
    controller = model.controller(START, CUP, trust=None, smoothing=None)
    commands = []
    for _ in range(TICKS):
        commands.append(controller.step(DT))
        assert controller._follower.moment.behind is None  # every step was taken exactly
    return commands


@needs_compiler
def test_it_is_the_controller(package, expected):
    exported = load_exported(package)
    assert exported.joint_names == ("turn", "bend")
    assert exported.frame_names == (OBJECT,)
    assert (exported.begin, exported.end) == (0.0, 1.0)
    assert exported.bounds["velocity"] == [300.0, 300.0]
    commands = [exported.reset(START, CUP), *(exported.step(DT) for _ in range(TICKS - 1))]
    for one, other in zip(commands, expected, strict=True):
        for actual, wanted in (
            (one.reference, other.reference),
            (one.velocity, other.velocity),
            (one.covariance, other.estimate.covariance),
            (torch.tensor(one.time, dtype=torch.float64), other.time),
        ):
            # wanted postures are rounded to 2^-32 in the controller: in speed that is more
            torch.testing.assert_close(actual, wanted, rtol=0, atol=3e-7)
        assert one.status.code == int(other.codes)
    assert commands[-1].status is Status.FINISHED


@needs_compiler
def test_the_robot_rests_while_something_is_missing_and_goes_on(package):
    exported = load_exported(package)
    last = exported.reset(START, CUP)
    limit = torch.tensor(exported.bounds["acceleration"]) * (1 + 1e-6)
    lost, slope = [[float("nan")] * 7], torch.zeros(2)
    for tick in range(400):
        missing = 40 <= tick < 120
        now = exported.step(DT, frames=lost if missing else CUP)
        change = (now.reference - last.reference) / DT
        assert bool(now.reference.isfinite().all() & now.covariance.isfinite().all())
        assert bool(((change - slope).abs() <= limit * DT).all())
        assert now.status is Status.HOLDING or not missing
        if missing:
            assert now.time == last.time
        if tick == 119:
            assert float(now.velocity.abs().max()) < 1e-9
        last, slope = now, change
    assert last.status is Status.FINISHED
    again = exported.step(-1.0)
    assert again.status is Status.HOLDING
    assert torch.equal(again.reference, last.reference)
    assert exported.step(DT, joints=[float("nan")] * 2).status is Status.HOLDING


@needs_compiler
def test_input_that_does_not_fit_is_refused(package):
    exported = load_exported(package)
    with pytest.raises(DataError, match="call reset"):
        exported.step(DT)
    with pytest.raises(DataError, match="begins where the robot stands"):
        exported.reset([0.0, float("nan")], CUP)
    with pytest.raises(UnknownNameError, match=OBJECT):
        exported.reset(START, {})
    with pytest.raises(ShapeError, match=r"2 numbers \(turn, bend\)"):
        exported.reset([0.0], CUP)
    with pytest.raises(ShapeError, match=r"shape \(1, 7\)"):
        exported.reset(START, torch.zeros(7))
    with pytest.raises(DataError, match="no finite answer"):
        exported.reset(START, torch.zeros(1, 7))


@needs_compiler
def test_packages_of_another_kind_are_not_run(package, tmp_path, monkeypatch):
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_exported(tmp_path / "nothing.pt2")
    (tmp_path / "text.pt2").write_text("text")
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_exported(tmp_path / "text.pt2")
    with zipfile.ZipFile(tmp_path / "other.pt2", "w") as other:
        other.writestr("a_metadata.json", json.dumps({"device": "cpu"}))
    with pytest.raises(ModelFileError, match=r"no controller"):
        load_exported(tmp_path / "other.pt2")
    monkeypatch.setattr(exported_module, "FORMAT", 99)
    with pytest.raises(ModelFileError, match="reads 99"):
        load_exported(package)
    monkeypatch.undo()
    monkeypatch.setattr(torch, "__version__", "1.0")
    with pytest.raises(ModelFileError, match=r"torch .*this is '1.0'"):
        load_exported(package)


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_the_example_in_cpp_prints_the_same_numbers(package, expected, tmp_path):
    root = f"-DTORCH_ROOT={Path(torch.__file__).parent}"
    for command in (["-S", EXAMPLE, "-B", tmp_path, root], ["--build", tmp_path]):
        done = subprocess.run(["cmake", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    cup = [*CUP[OBJECT].position.tolist(), *CUP[OBJECT].orientation.tolist()]
    done = subprocess.run(
        [tmp_path / "control_loop", package, str(DT), str(TICKS)],
        input=" ".join(map(str, [*START, *cup])),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    actual = torch.tensor(
        [[*map(float, row.split())] for row in done.stdout.splitlines()], dtype=torch.float64
    )
    wanted = torch.stack([command.reference for command in expected])
    torch.testing.assert_close(actual, wanted, rtol=0, atol=1e-9)


@needs_compiler
def test_it_is_the_graph_wherever_the_robot_is(model, package):
    exported, tick = load_exported(package), graph(model, "localizing", model.motion_bounds())
    stands = torch.tensor(START, dtype=torch.float64)
    exported.reset(stands, CUP)
    state, reference, *_ = tick(torch.zeros(tick.size), stands)
    for now in range(1, 200):
        if not 40 <= now < 90:  # else it is held
            stands = reference
        command = exported.step(DT, stands)
        state, reference, _, covariance = tick(state, stands)
        torch.testing.assert_close(command.reference, reference, rtol=0, atol=1e-9)
        torch.testing.assert_close(command.covariance, covariance, rtol=0, atol=1e-9)
        assert command.time == pytest.approx(float(state[0]), abs=1e-9)
    assert command.status is Status.FINISHED


def graph(model, clock, bounds):
    """What is compiled, as it is: from a state and measured joints on."""
    settings = {f.name: getattr(model.regression(), f.name) for f in fields(Regression)}
    regression = CompiledRegression(**settings)
    names, span = regression.served_frames, (float(model.time_[0]), float(model.time_[-1]))
    tick = ExportedTick(regression, names, *span, model.blend, bounds, parse_clock(clock))
    cup = torch.cat((CUP[OBJECT].position, CUP[OBJECT].orientation))[None]
    step = torch.tensor(DT, dtype=torch.float64)

    def run(state, joints):
        with torch.inference_mode():
            return tick(state.double(), step, joints, cup)

    run.size = tick.size
    return run


@pytest.fixture(scope="module")
def waving():
    """Two joints that take four seconds for a way that is nowhere the same."""
    time = torch.linspace(0, 4, 100, dtype=torch.float64)[:, None]
    went, wave = minimum_jerk(time / 4), 0.3 * torch.sin(time)
    demonstrations = [
        Demonstration(
            time[:, 0],
            torch.cat((1.2 * went - 0.6 + gap * (1 - went), 0.5 + 0.6 * went + wave), 1),
            CUP,
        )
        for gap in torch.linspace(-0.2, 0.2, 5, dtype=torch.float64)
    ]
    task = RelativePosition("hand", OBJECT), RelativeOrientation("hand", OBJECT)
    return TaskParameterizedGMM(6, [Stack(*task), Canonical()], ARM, blend=0.3).fit(
        demonstrations
    )


@pytest.mark.parametrize(
    ("clock", "robot"),
    [
        ("even", "held"),
        ("waiting:arrivals=1.2", "slow"),
        ("localizing", "held"),
        ("localizing", "pushed"),
        ("localizing:speed=1.5,lag=0.05", "slow"),
    ],
)
def test_clocks_are_those_of_the_controller(waving, clock, robot):
    one = torch.ones(2, dtype=torch.float64)
    bounds = MotionBounds(-3 * one, 3 * one, 300 * one, 1e6 * one, 1e9 * one)  # out of the way
    controller = waving.controller(
        [-0.6, 0.5], CUP, clock=clock, trust=None, smoothing=None, bounds=bounds
    )
    tick = graph(waving, clock, bounds)
    stands, past, moved = torch.tensor([-0.6, 0.5], dtype=torch.float64), None, 0
    state, times = torch.zeros(tick.size), []
    for now in range(450):
        command = controller.step(DT, joints=stands)
        moved += bool(controller._progress.relocalized)
        state, reference, velocity, covariance = tick(state, stands)
        for actual, wanted, error in (
            (reference, command.reference, 1e-8),
            (velocity, command.velocity, 1e-6),
            (covariance, command.covariance, 1e-8),
            (state[0], command.time.reshape(()), 1e-8),
        ):
            torch.testing.assert_close(actual, wanted, rtol=0, atol=error)
        times.append(float(state[0]))
        went, last = reference, stands
        past = went if now == 60 else past
        if robot == "held" and 150 <= now < 260:
            went = last
        elif robot == "pushed" and 150 <= now < 190:
            went = past
        stands = last + 0.05 * (went - last) if robot == "slow" else went
    if clock == "localizing":
        assert moved == 1  # let go it goes on from where it was held, or pushed back to
        back = times[149] - min(times[155:275])
        assert abs(back) < 0.1 if robot == "held" else back > 0.3


@pytest.fixture(scope="module")
def grasping():
    """The same with a gripper that closes on something after 1.5 s."""
    robot = Robot.from_urdf(
        URDF, ["hand"], coordinates=["gripper"], tools={"hand": ("lower", [0.2, 0, 0])}
    )
    time = torch.linspace(0, 4, 100, dtype=torch.float64)[:, None]
    went, wave = minimum_jerk(time / 4), 0.3 * torch.sin(time)
    closed = minimum_jerk(((time - 1.5) / 0.5).clamp(0, 1))
    demonstrations = [
        Demonstration(
            time[:, 0],
            torch.cat((1.2 * went - 0.6 + gap * (1 - went), 0.5 + wave, 1 - closed), 1),
            CUP,
        )
        for gap in torch.linspace(-0.2, 0.2, 5, dtype=torch.float64)
    ]
    task = RelativePosition("hand", OBJECT), RelativeOrientation("hand", OBJECT)
    return TaskParameterizedGMM(8, [Stack(*task), Canonical()], robot, blend=0.3).fit(
        demonstrations
    )


@pytest.mark.parametrize("trust", [None, Trust()], ids=["believing", "wary"])
@pytest.mark.parametrize("clock", ["waiting", "localizing", "waiting:arrivals=1.8"])
def test_a_gripper_that_holds_something_is_not_waited_for(grasping, clock, trust):
    """What it holds keeps it open: it is as if it were not measured."""
    bounds = grasping.motion_bounds()
    stands = torch.tensor([-0.6, 0.5, 1.0], dtype=torch.float64)
    controller = grasping.controller(stands, CUP, clock=clock, trust=trust, smoothing=None)
    tick, state = graph(grasping, clock, bounds), None
    for now in range(440):
        command = controller.step(DT, joints=stands)
        if trust is None:
            state, reference, *_ = tick(torch.zeros(tick.size) if now == 0 else state, stands)
            torch.testing.assert_close(reference, command.reference, rtol=0, atol=1e-8)
        assert float(command.time) == pytest.approx(min(now * DT, 4.0), abs=1e-6)
        stands = command.reference.clone()
        stands[2] = stands[2].clamp(min=0.6)
    assert command.status is Status.FINISHED
    assert float(command.reference[2]) < 0.1  # it still presses


def test_an_arm_that_is_held_is_waited_for_while_its_gripper_moves(grasping):
    stands = torch.tensor([-0.6, 0.5, 1.0], dtype=torch.float64)
    controller = grasping.controller(stands, CUP, clock="localizing", smoothing=None)
    for now in range(500):
        command = controller.step(DT, joints=stands)
        held = stands[:2]
        stands = command.reference.clone()
        if 160 <= now < 360:
            stands[:2] = held
        stands[2] = stands[2].clamp(min=0.6)
        if now == 355:
            assert float(command.time) < 2.4
            assert float(command.reference[2]) < 0.75  # and is not opened meanwhile


@pytest.mark.parametrize("clock", ["even", "localizing"])
def test_parts_are_exported(shown, clock):
    task = RelativePosition("hand", OBJECT), RelativeOrientation("hand", OBJECT)
    lists = [[Canonical()], [Stack(*task), Canonical()]]  # the cup does not matter in the first
    model = TaskParameterizedGMM(4, lists, ARM, parts=[0.5], blend=0.3).fit(shown)
    assert len(model.parts_) == 2
    controller = model.controller(START, CUP, clock=clock, trust=None, smoothing=None)
    tick = graph(model, clock, model.motion_bounds())
    stands = torch.tensor(START, dtype=torch.float64)
    state = torch.zeros(tick.size)
    for _ in range(TICKS):
        command = controller.step(DT, joints=stands)
        state, reference, velocity, covariance = tick(state, stands)
        torch.testing.assert_close(reference, command.reference, rtol=0, atol=1e-8)
        torch.testing.assert_close(velocity, command.velocity, rtol=0, atol=1e-6)
        torch.testing.assert_close(covariance, command.estimate.covariance, rtol=0, atol=1e-8)
        torch.testing.assert_close(state[0], command.time.reshape(()), rtol=0, atol=1e-8)
        stands = reference
    assert command.status is Status.FINISHED


def test_what_cannot_be_exported_is_said(model, tmp_path, monkeypatch):
    for clock in (LocalizingClock(initial="anywhere"), type("Own", (WaitingClock,), {})()):
        with pytest.raises(DataError, match="run other clocks with controller"):
            model.export(tmp_path / "a.pt2", clock=clock)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(DependencyError, match=r"export\(\) needs a C\+\+ compiler"):
        model.export(tmp_path / "a.pt2")
    assert not list(tmp_path.iterdir())


def test_every_tick_keeps_the_bounds_wherever_it_is_sent():
    one, generator = torch.ones(32, dtype=torch.float64), torch.Generator().manual_seed(0)
    bounds = MotionBounds(-one, one, 2 * one, 8 * one, 200 * one)
    law, dt, rows = (
        BrakingLaw(bounds),
        torch.tensor(DT, dtype=torch.float64),
        one.new_zeros(8, 32),
    )
    references, last = [rows[0]], torch.zeros_like(dt)
    for tick in range(300):
        if tick % 60 == 0:
            wanted = 3 * torch.rand(32, generator=generator, dtype=torch.float64) - 1.5
            drift = torch.randn(32, generator=generator, dtype=torch.float64) * (tick % 120 > 0)
        wanted = wanted + DT * drift
        rows = law.follow(rows, wanted, torch.tensor(tick % 100 > 10), dt, last)
        last = dt
        references.append(rows[0])
    at = torch.stack(references)
    for order, bound in enumerate((1.0, 2.0, 8.0, 200.0)):
        # rounding of a position comes back divided by each tick
        largest = float((torch.diff(at, order, dim=0) / DT**order).abs().max())
        assert largest <= bound * (1 + 1e-8) + 1e-15 / DT**order
    for _ in range(200):
        rows = law.follow(rows, 0.5 * one, torch.tensor(True), dt, dt)
    assert torch.equal(rows[0], 0.5 * one)

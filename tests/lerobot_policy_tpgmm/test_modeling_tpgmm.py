"""What a policy does is what its model predicts, in every way that LeRobot asks for it."""

import pytest
import torch

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import skills
from tests.support.carrying import carrying_model, scenes
from tests.support.policies import (
    ENVIRONMENT,
    OPEN,
    STATE,
    act,
    batch,
    changed,
    fitted,
    grouped,
    played,
    policy,
    pose,
    situations,
)
from tpgmm_control import Controller
from tpgmm_control.loop.rollout import rollout
from tpgmm_torch import Canonical, Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.data.pose_names import POSE_PARTS
from tpgmm_torch.exceptions import DataError, ModelFileError, NotFittedError, ShapeError

#: Actions per second in tests of the closed loop: a robot that is held is missed for longer.
RATE = 20.0
STEPS = len(skills.small_bottle().time_)


def predict(model: TaskParameterizedGMM, given: list[Situation]) -> torch.Tensor:
    found = rollout(model.skill, given, bounds="robot", blend=1.0)
    return torch.stack([trajectory.joints for trajectory in found])


def assert_close(actions: torch.Tensor, joints: torch.Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(actions.double(), joints, rtol=tolerance, atol=tolerance)


def test_open_loop_it_is_what_the_model_predicts():
    actions = act(played(), batch(), STEPS)
    assert actions.dtype == torch.float32 and actions.shape == (2, STEPS, 17)
    assert_close(actions, predict(skills.small_bottle(), situations(batch())))
    assert float((actions[0] - actions[1]).abs().max()) > 0.1


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_start_off_the_skill_is_blended_in_as_predict_does():
    observed = batch()
    observed[STATE][0, 4] += 0.5
    actions = act(played(), observed, STEPS)
    assert_close(actions[:, 0], observed[STATE].double())
    assert_close(actions, predict(skills.small_bottle(), situations(observed)))


def test_after_the_end_it_holds():
    actions = act(played(), batch(), STEPS + 5)
    assert torch.equal(actions[:, STEPS:], actions[:, STEPS - 1 : -5][:, :1].expand(-1, 5, -1))


@pytest.mark.parametrize("rate", [5.0, 12.5])
def test_time_advances_by_the_control_rate(rate):
    model = skills.small_bottle()
    duration = float(model.time_[-1])
    time = torch.arange(0, duration, 1 / rate, dtype=torch.float64)
    actions = act(changed(played(), control_fps=rate), batch(), len(time))
    # where a bound is just reached, rounding decides between two ways to keep it
    assert_close(actions, predict(model, situations(batch(), time)), 1e-5)
    assert fitted().config.fps == pytest.approx((STEPS - 1) / duration, abs=1e-6)


def test_a_chunk_is_what_follows_and_changes_nothing():
    whole = act(played(), batch(), STEPS)
    short = changed(played(), chunk_size=7)
    with torch.inference_mode():
        assert torch.equal(short.predict_action_chunk(batch()), whole[:, :7])
        for step in range(20):
            assert torch.equal(short.select_action(batch()), whole[:, step])
            ahead = short.predict_action_chunk(batch())
            assert torch.equal(ahead, whole[:, step + 1 : step + 8])
    assert played().predict_action_chunk(batch()).shape == (2, 50, 17)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_an_episode_begins_with_reset():
    acting, first, second = played(), batch(), batch()
    second[STATE] += 0.1
    one, other = act(acting, first, 5), act(acting, second, 5)
    assert_close(other[:, 0], second[STATE].double())
    assert torch.equal(act(acting, first, 5), one)


@pytest.mark.parametrize("feedback", ["reference", "observation"])
def test_a_sub_environment_that_jumps_disturbs_no_other(feedback):
    acting = changed(fitted(), feedback=feedback)
    observed, alone = batch(), {key: value[:1] for key, value in batch().items()}
    wanted = act(acting, alone, 30)
    acting.reset()
    for step in range(30):
        now = {key: value.clone() for key, value in observed.items()}
        if step > 10:  # finished, and reset to somewhere else
            now[STATE][1] = -now[STATE][1]
            now[ENVIRONMENT][1, :3] += 1.0
        with torch.inference_mode():
            action = acting.select_action(now)
        assert_close(action[:1], wanted[:, step].double())


def test_q_before_may_be_what_was_measured():
    model = skills.small_bottle()
    acting = policy(feedback="observation", clock="even", keep_limits=False, blend=0.0)
    generator = torch.Generator().manual_seed(0)
    frames = {"bottle": Frame(*batch()[ENVIRONMENT].double().split([3, 4], dim=-1))}
    action = batch()[STATE]
    for time in model.time_[:10]:
        noise = 0.02 * torch.randn(2, 17, generator=generator)
        now = {**batch(), STATE: action + noise}
        with torch.inference_mode():
            action = acting.select_action(now)
        assert_close(action, model.step(time, now[STATE].double(), frames).joints)
    with pytest.raises(ShapeError, match=r"began with 2 robots, now there are 1"):
        acting.select_action({key: value[:1] for key, value in batch().items()})


@pytest.mark.parametrize("follow", [False, True])
def test_objects_are_read_at_the_start_or_followed(follow):
    acting = changed(played(), follow_frames=follow)
    path = batch()[ENVIRONMENT].double()[:1].repeat(STEPS, 1)
    path[:, :3] += 0.05 * skills.small_bottle().time_[:, None] / skills.small_bottle().time_[-1]
    acting.reset()
    with torch.inference_mode():
        observed = [{STATE: batch()[STATE][:1], ENVIRONMENT: at[None].float()} for at in path]
        actions = torch.cat([acting.select_action(one) for one in observed])
    seen = path.float().double() if follow else path.float().double()[0]
    [situation] = situations({key: value[:1] for key, value in batch().items()})
    frame = Frame(seen[..., :3], seen[..., 3:])
    moved = Situation(situation.joints, {"bottle": frame}, skills.small_bottle().time_)
    # the place of an object that creeps follows it within a second
    assert_close(actions, predict(skills.small_bottle(), [moved])[0], 0.03 if follow else 1e-6)
    if follow:
        stood = predict(skills.small_bottle(), situations(batch()))[0]
        assert float((actions - stood).abs().max()) > 0.06


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_robot_that_stands_far_from_the_start_is_refused():
    observed = batch()
    observed[STATE][1, 7] += 1.8
    message = r"'l_forearm_yaw' of robot 1 stands at .*--policy.units.*--policy.control.largest"
    with pytest.raises(DataError, match=message):
        act(fitted(), observed, 1)
    changed(fitted(), largest_start_gap=None).select_action(observed)
    degrees = {**batch(), STATE: batch()[STATE].rad2deg()}
    with pytest.raises(DataError, match=r"start posture: l_elbow = .* cannot be in radians"):
        act(fitted(), degrees, 1)


def test_joints_alone_need_no_robot_and_no_frames():
    model = skills.canonical().fit(skills.waves())
    acting = TPGMMPolicy.from_estimator(model, **grouped(**OPEN))
    assert set(acting.config.input_features) == {STATE}
    start = skills.waves()[1].joints[0]
    actions = act(acting, {STATE: start[None].float()}, len(model.time_))
    # from rest, accelerated as was demonstrated at most three times over
    expected = predict(model, [Situation(start.float().double())])[0]
    assert (actions[0, 1] - start).abs().max() < 0.1 < (expected[1] - start).abs().max()
    assert_close(actions[0, 10:], expected[10:])


def test_tracked_bodies_are_moved_on_their_manifold():
    situation, _ = skills.new_handling()
    acting = TPGMMPolicy.from_estimator(
        skills.hands(), **grouped(largest_start_gap=None, **OPEN)
    )
    cup = situation.frames["cup"]
    observed = {STATE: situation.joints[None].float(), ENVIRONMENT: pose(cup)[None].float()}
    actions = act(acting, observed, len(skills.hands().time_))[0]
    at = observed[ENVIRONMENT][0].double()
    given = Situation(observed[STATE][0].double(), {"cup": Frame(at[:3], at[3:])})
    assert_close(actions, predict(skills.hands(), [given])[0])
    for start in skills.HANDS.quaternion_starts:
        norms = actions[:, start : start + 4].norm(dim=-1)
        torch.testing.assert_close(norms, torch.ones_like(norms), rtol=0, atol=1e-5)


# Closed loop


def close_loop(**fields: object) -> TPGMMPolicy:
    return changed(fitted(), control_fps=RATE, **fields)


def run(acting: TPGMMPolicy, steps: int, observe, rows: slice = slice(None)) -> torch.Tensor:
    """Actions (B, steps, n) for robots that are where they were sent, if ``observe`` agrees."""
    acting.reset()
    state, actions = batch()[STATE], []
    for step in range(steps):
        now = observe(step, {**batch(), STATE: state.clone()})
        with torch.inference_mode():
            action = acting.select_action({key: value[rows] for key, value in now.items()})
        actions.append(action)
        state = state.clone()
        state[rows] = action
    return torch.stack(actions, dim=1)


def as_it_is(step, now):
    return now


def test_a_robot_that_follows_is_moved_as_in_open_loop():
    steps = round(float(skills.small_bottle().time_[-1]) * RATE)
    # followed frames differ in the last bit, which this coarse model makes much of
    actions = run(close_loop(follow_frames=False), steps, as_it_is)
    assert_close(actions, act(changed(played(), control_fps=RATE), batch(), steps).double())
    wanted = predict(skills.small_bottle(), situations(batch()))
    assert_close(run(changed(fitted(), joint_timeout=1.0), STEPS, as_it_is), wanted)


def test_each_robot_of_a_batch_does_what_it_does_alone():
    together = run(close_loop(), 60, as_it_is)
    for row in range(2):
        alone = run(close_loop(), 60, as_it_is, slice(row, row + 1))
        assert_close(together[row : row + 1], alone.double())


@pytest.mark.parametrize("what", [STATE, ENVIRONMENT])
def test_a_robot_that_cannot_be_believed_is_held_and_goes_on(what, caplog):
    def observe(step, now):
        if 40 <= step < 90:
            now[what] = now[what].clone()
            now[what][1] = float("nan")
        return now

    undisturbed = run(close_loop(), 120, as_it_is)
    with caplog.at_level("INFO"):
        actions = run(close_loop(), 120, observe)
    log = [line.removeprefix("robot 1 at ") for line in caplog.messages]
    assert [line.split()[5] for line in log] == ["holding:", "running"]
    assert "is missing or not finite" in log[0]
    assert bool(actions.isfinite().all())
    # later a last bit decides, for two ticks, between two postures that are wanted
    assert_close(actions[:1, :100], undisturbed[:1, :100].double())
    speed = actions.diff(dim=1).abs() * RATE
    # after its patience and braking it stands, and then it moves again
    assert float(speed[1, 68:88].max()) < 1e-3 < 0.05 < float(speed[1, 92:].max())
    assert bool((speed <= fitted().kinematics.velocity * (1 + 1e-4)).all())


def test_timestamps_tell_how_much_time_has_passed():
    def stamp(step, now):
        time = torch.full((2, 1), step * period, dtype=torch.float64)
        return {**now, "observation.timestamp": time}

    for period in (2 / RATE, 1 / (2 * RATE)):
        wanted = run(changed(close_loop(), control_fps=1 / period), 12, as_it_is)
        assert_close(run(close_loop(), 12, stamp), wanted.double())


# Chunks


def alone() -> dict[str, torch.Tensor]:
    return {key: value[:1] for key, value in batch().items()}


def test_chunks_go_on_from_where_the_robot_is():
    acting = close_loop(chunk_size=20)
    whole = close_loop(chunk_size=100).predict_action_chunk(alone())
    speed = whole.diff(dim=1).abs().amax()
    assert float(speed) > 0.01  # it does not stop for want of observations
    acting.reset()
    sent = [acting.predict_action_chunk(alone())[0, :8]]
    for _ in range(9):
        now = {**alone(), STATE: sent[-1][-1:]}
        sent.append(acting.predict_action_chunk(now)[0, :8])
    actions = torch.cat(sent)
    assert float(actions.diff(dim=0).abs().amax()) < 2 * float(speed)
    assert_close(actions[:30], whole[0, :30].double(), 1e-3)


@pytest.mark.parametrize("source", ["timestamp", "left over"])
def test_what_tells_the_step_counts_more_than_the_posture(source):
    acting = close_loop(chunk_size=20)
    chunk = acting.predict_action_chunk({**alone(), "observation.timestamp": torch.zeros(1, 1)})
    now = {**alone(), STATE: chunk[0, 3:4]}  # the robot lags behind the seventh action
    more = {}
    if source == "timestamp":
        now["observation.timestamp"] = torch.full((1, 1), 7 / RATE)
    else:
        more = {"inference_delay": 0, "prev_chunk_left_over": chunk[0, 7:]}
    assert_close(acting.predict_action_chunk(now, **more)[:, :5], chunk[:, 7:12].double(), 1e-3)
    assert acting.supports_rtc()


# Estimators


class Mine(Canonical):
    """An operator of one's own."""


def test_estimators_that_cannot_be_written_are_refused():
    with pytest.raises(NotFittedError, match="call fit"):
        TPGMMPolicy.from_estimator(skills.bottle_model())
    model = skills.canonical(operators=[Mine()]).fit(skills.waves())
    with pytest.raises(ModelFileError, match="'Mine', which is not known here"):
        TPGMMPolicy.from_estimator(model)


def test_what_is_held_is_part_of_the_policy(tmp_path):
    model, scene = carrying_model(), scenes(2, seed=9)
    names = [f"{frame}.{part}" for frame in ("bottle", "tray") for part in POSE_PARTS]
    loop = {"clock": "even", "closed_loop": False, "smoothing": None}
    policy = TPGMMPolicy.from_estimator(model, environment_names=names, **grouped(**loop))
    policy.save_pretrained(tmp_path)
    loaded = TPGMMPolicy.from_pretrained(tmp_path)
    assert loaded.to_estimator().holds_ == model.holds_
    poses = [x for f in scene.frames.values() for x in (f.position, f.orientation)]
    seen = {STATE: scene.start.float(), ENVIRONMENT: torch.cat(poses, -1).float()}
    options = policy.config.control.options()
    controller = Controller(model.skill, scene.start, scene.frames, **options)
    for now in model.time_.tolist():
        actions = loaded.select_action(seen)
        controller.step(1 / policy.config.rate)
        if now == 4.5:  # carried, and calm
            assert_close(actions, controller.reference, 1e-4)
    # the bottle is seen where it was at first, all the time: that is no news
    there = controller.holding.frames["bottle"].position
    assert float((there - scene.tray.position).norm(dim=-1).max()) < 2e-3
    assert_close(loaded._controller.holding.frames["bottle"].position, there, 1e-4)
    with pytest.raises(DataError, match=r"hold 'bottle' is not of the form"):
        TPGMMConfig(holds=["bottle"])

"""A policy with a cell finds its frames in pictures, waits for them, says what it misses."""

import json

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.envs import preprocess_observation

from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.rendering import offscreen
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import recorded_tags
from tests.support.lerobot_commands import lerobot
from tests.support.planted_poses import ENTRY, HEIGHT, KEY, WIDTH, cell_content, pictures
from tests.support.policies import ENVIRONMENT, OPEN, STATE, batch, changed, fitted, policy
from tests.support.recorded_tags import BASE_FROM_CAMERA
from tpgmm_torch.exceptions import DataError
from tpgmm_vision import sources
from tpgmm_vision.poses import inverse, pose_matrix, pose_vector, rigid

pytestmark = pytest.mark.slow

RATE = 25.0
needs_pictures = pytest.mark.skipif(offscreen() is None, reason="nothing can be drawn here")
LOST = np.full(7, np.nan)


@pytest.fixture(autouse=True)
def install_source(monkeypatch):
    """The source of poses of these tests is installed."""
    monkeypatch.setattr(sources, "entry_points", lambda group: [ENTRY])


def seeing(**options: object) -> TPGMMPolicy:
    return policy(cell=cell_content(), control_fps=RATE, **options)


def observe_start(lost=(), kind=torch.float32, rows=2):
    """What is observed at the start, with pictures in place of poses."""
    poses = batch()[ENVIRONMENT].double().numpy()[:rows]
    shown = [LOST if row in lost else pose for row, pose in enumerate(poses)]
    return {STATE: batch()[STATE][:rows], KEY: pictures(shown, kind)}


def lines(caplog):
    return [record.getMessage() for record in caplog.records]


def test_pictures_are_among_what_it_needs():
    acting = seeing()
    feature = acting.config.input_features[KEY]
    assert feature.type is FeatureType.VISUAL and feature.shape == (3, HEIGHT, WIDTH)
    assert KEY not in fitted().config.input_features


@pytest.mark.parametrize("kind", [torch.float32, torch.uint8])
def test_it_does_what_it_does_with_the_poses_themselves(kind):
    acting, usual = seeing(**OPEN), changed(fitted(), control_fps=RATE, **OPEN)
    start = batch()[STATE]
    for _ in range(2):  # three pictures are looked at before it begins
        assert torch.equal(acting.select_action(observe_start(kind=kind)), start)
    for _ in range(20):
        now = acting.select_action(observe_start(kind=kind))
        torch.testing.assert_close(now, usual.select_action(batch()), rtol=0, atol=1e-5)
    before = [source.resets for source in acting.watch.sources]
    acting.reset()
    assert torch.equal(acting.select_action(observe_start()), start)
    assert [source.resets for source in acting.watch.sources] == [n + 1 for n in before]


def test_pictures_count_more_than_the_state_of_the_environment():
    acting, other = seeing(**OPEN), seeing(**OPEN)
    misled = {ENVIRONMENT: batch()[ENVIRONMENT] + 0.3}
    for _ in range(10):
        one = acting.select_action(observe_start())
        two = other.select_action(observe_start() | misled)
    assert torch.equal(one, two)


def test_a_source_is_given_joints_by_name_and_the_time():
    acting = seeing()
    for tick in range(3):
        stamp = {"observation.timestamp": torch.full((2, 1), 0.04 * tick)}
        acting.select_action(observe_start() | (stamp if tick < 2 else {}))
    joints, time = acting.watch.sources[1].calls[-1]
    assert time == pytest.approx(0.08)
    wanted = dict(zip(acting.kinematics.joint_names, batch()[STATE][1].tolist(), strict=True))
    assert joints == pytest.approx(wanted)


def test_robots_stand_until_all_objects_were_seen(caplog):
    acting, start = seeing(), batch()[STATE]
    with caplog.at_level("INFO"):
        for _ in range(40):
            assert torch.equal(acting.select_action(observe_start(lost=[1])), start)
    waits = "holding before the start: robot 1 does not see 'bottle' (a hand hides it)"
    assert lines(caplog)[-1] == waits
    for _ in range(4):
        action = acting.select_action(observe_start())
    assert not torch.equal(action, start)
    acting.reset()
    for _ in range(round(5 * RATE)):
        assert torch.equal(acting.select_action(observe_start(lost=[1])), start)
    message = r"robot 1 does not see 'bottle' \(a hand hides it\), for 5 s .*\['front'\]"
    with pytest.raises(DataError, match=message):
        for _ in range(3):
            acting.select_action(observe_start(lost=[1]))


def test_one_wrong_pose_of_the_first_ones_does_not_count():
    acting = seeing(**OPEN)
    wrong = observe_start()
    wrong[KEY] = pictures(batch()[ENVIRONMENT].double().numpy() + np.eye(7)[0])
    seen = [wrong, observe_start(), observe_start()]
    for one in seen:
        acting.select_action(one)
    frame = acting._controller._first_frames["bottle"].position
    torch.testing.assert_close(frame, batch()[ENVIRONMENT][:, :3].double())


def run(acting, ticks, lost, held=()):
    """The actions of a robot that follows, which is alone, and does not see at some ticks."""
    state, actions = batch()[STATE][:1], []
    for tick in range(ticks):
        now = observe_start(lost=[0] if tick in lost else [], rows=1) | {STATE: state}
        if acting._controller is not None:
            acting.watch.sources[0].problem = "camera 'front' was moved" if tick in held else ""
        state = acting.select_action(now)
        actions.append(state[0])
    return torch.stack(actions)


def test_what_is_not_seen_for_long_holds_the_robot_and_is_told(caplog):
    acting = seeing()
    whole = run(seeing(), 160, ())
    with caplog.at_level("INFO"):
        actions = run(acting, 160, range(40, 100))
    first, held, back = lines(caplog)[-3:]
    assert first.endswith("running: 'bottle' (a hand hides it) is not seen for 0.52 s")
    assert "holding: frame 'bottle' is missing or not finite, for" in held
    assert back.endswith("of the skill: running")
    torch.testing.assert_close(actions[:60], whole[:60])
    speed = actions.diff(dim=0).abs().amax(1) * RATE
    assert float(speed[85:98].max()) < 1e-3 < 0.02 < float(speed[110:].max())


def test_most_pictures_may_show_nothing():
    rng = np.random.default_rng(0)
    lost = set(np.flatnonzero(rng.random(160) < 0.7).tolist()) - {0, 1, 2}
    blind, seen = run(seeing(), 160, lost), run(seeing(), 160, ())
    torch.testing.assert_close(blind, seen, rtol=0, atol=0.02)


def test_a_camera_that_was_moved_holds_the_robot_with_its_reason(caplog):
    acting = seeing()
    with caplog.at_level("INFO"):
        actions = run(acting, 120, (), held=range(40, 80))
    held, back = lines(caplog)[-2:]
    assert held.endswith("of the skill: holding: camera 'front' was moved")
    assert back.endswith("of the skill: running")
    speed = actions.diff(dim=0).abs().amax(1) * RATE
    assert float(speed[60:79].max()) < 1e-3 < 0.02 < float(speed[85:].max())


def test_chunks_stand_while_nothing_can_be_trusted():
    acting = seeing(chunk_size=20)
    start = batch()[STATE][:1]
    for _ in range(2):
        chunk = acting.predict_action_chunk(observe_start(rows=1))
        assert torch.equal(chunk, start[None].expand(1, 20, -1))
    one = acting.predict_action_chunk(observe_start(rows=1))
    assert float((one[:, -1] - start).abs().max()) > 1e-3
    acting.watch.sources[0].problem = "camera 'front' was moved"
    two = acting.predict_action_chunk(observe_start(rows=1) | {STATE: one[:, 5]})
    assert float(two.diff(dim=1).abs()[:, 10:].max()) < 1e-4


def test_objects_may_be_read_at_the_start_alone():
    acting = seeing(**OPEN)
    for _ in range(3):
        acting.select_action(observe_start())
    acting.select_action({STATE: batch()[STATE]})
    assert len(acting.watch.sources[0].calls) == 3


@pytest.mark.parametrize(
    ("spoiled", "message"),
    [
        (lambda now: {STATE: now[STATE]}, r"'front' .* takes the pictures .*\[\]"),
        (lambda now: now | {KEY: now[KEY][..., :-8]}, r"calibrated for 32 x 24 .*got 24 x 24"),
        (lambda now: now | {KEY: 255 * now[KEY]}, r"values from 0 to 1"),
        (lambda now: now | {KEY: now[KEY] * torch.nan}, r"values from 0 to 1"),
        (lambda now: now | {KEY: now[KEY][0]}, r"shape \(B, 3, height, width\), got \(3, 24"),
    ],
)  # fmt: skip
def test_pictures_that_are_not_those_of_the_camera_are_refused(spoiled, message):
    with pytest.raises(DataError, match=message):
        seeing().select_action(spoiled(observe_start()))


def test_other_pictures_are_not_looked_at():
    more = observe_start() | {"observation.images.wrist": torch.full((2, 3, 5, 5), torch.nan)}
    assert torch.equal(seeing().select_action(more), batch()[STATE])


# Cells


def load_again(folder, cell=None):
    given = [] if cell is None else [f"--cell={cell}"]
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=given)
    return TPGMMPolicy.from_pretrained(folder, config=config)


def test_it_remembers_the_cell_and_takes_another(tmp_path, caplog):
    seeing().save_pretrained(tmp_path / "policy")
    same = load_again(tmp_path / "policy")
    assert same.config.cell == cell_content() and KEY in same.config.input_features
    assert not any("another cell" in line for line in lines(caplog))
    other = cell_content(joint_offsets={"l_elbow": 0.02, "r_hip": 0.1})
    other["cameras"]["front"]["pose"] = [1.0, 0.02, 1.0, 1.0, 0.0, 0.0, 0.0]
    other["objects"]["bottle"]["target"] = {"tag": 4, "size": 0.06}
    (tmp_path / "cell.json").write_text(json.dumps(other))
    again = load_again(tmp_path / "policy", tmp_path / "cell.json")
    [said] = [line for line in lines(caplog) if "another cell" in line]
    for part in (
        "'front' of the cameras was moved by 20.0 mm and 0.00 deg",
        "'bottle' of the objects has another target",
        "joint 'l_elbow' is offset by +1.15 deg more",
    ):
        assert part in said
    # joints are measured with the offsets of the other cell, and commanded without
    elbow = again.kinematics.joint_names.index("l_elbow")
    joints = again.joints.joints(batch()[STATE].double())
    assert torch.allclose((joints - batch()[STATE])[:, elbow], torch.tensor(0.02).double())
    torch.testing.assert_close(again.joints.action(joints), batch()[STATE])
    again.save_pretrained(tmp_path / "again")
    assert load_again(tmp_path / "again").config.cell == other


@pytest.mark.parametrize("no", ["none", "null"])
def test_without_its_cameras_it_reads_poses_and_keeps_the_offsets(tmp_path, no):
    kept = cell_content(joint_offsets={"l_elbow": 0.02})
    changed(fitted(), cell=kept, control_fps=RATE).save_pretrained(tmp_path / "policy")
    blind = load_again(tmp_path / "policy", no)
    assert blind.watch is None and KEY not in blind.config.input_features
    assert blind.config.cell["joint_offsets"] == {"l_elbow": 0.02}
    assert blind.joints.scale[:, 1].max() == 0.02
    blind.select_action(batch())
    assert policy(cell="none").watch is None


def test_cells_that_do_not_fit_are_refused(tmp_path):
    (tmp_path / "cell.json").write_text("{")
    cup = cell_content(objects={"cup": {"target": {"tag": 3, "size": 0.06}}})
    for cell, error, message in (
        (cup, DataError, r"objects \['cup'\], not \['bottle'\].*cell=none"),
        (cell_content(joints=["pan", "lift"]), DataError, r"joints \['pan', .* this one has"),
        (str(tmp_path / "cell.json"), DataError, r"cell.json is no JSON"),
        (str(tmp_path / "nowhere.json"), OSError, r"nowhere.json"),
    ):
        with pytest.raises(error, match=message):
            policy(cell=cell)
    left = [name for name in fitted().kinematics.joint_names if name[0] == "l"]
    policy(cell=cell_content(joints=left))


# Commands


def draw_tags(folder, pose):
    """A cell with a camera above a tag, which is at a pose (7,), and the picture of that."""
    place = rigid(np.zeros(3), pose[:3])
    objects = {"bottle": {**recorded_tags.OBJECT, "upright": True}}
    cell = recorded_tags.cell_content(objects=objects)
    cell["cameras"]["front"]["pose"] = pose_vector(place @ BASE_FROM_CAMERA).tolist()
    (folder / "cell.json").write_text(json.dumps(cell))
    picture = recorded_tags.picture({3: inverse(place) @ pose_matrix(pose)})
    np.save(folder / "picture.npy", picture)
    return folder / "cell.json", folder / "picture.npy"


def rollout(home, *more):
    """What was sent to the robot of the tests, tick by tick, and what the command said."""
    names = [f"{name}.pos" for name in fitted().kinematics.joint_names]
    start = dict(zip(names, batch()[STATE][0].tolist(), strict=True))
    (home / "start.json").write_text(json.dumps(start))
    done = lerobot(
        "rollout", "--strategy.type=base", f"--policy.path={home / 'policy'}", "--fps=20",
        "--robot.type=bimanual", f"--robot.start={home / 'start.json'}",
        f"--robot.log={home / 'log.json'}", "--duration=2", "--task=shake",
        "--return_to_initial_position=false", f"--policy.state_names={json.dumps(names)}",
        f"--policy.action_names={json.dumps(names)}", *more, home=home,
    )  # fmt: skip
    return done, home / "log.json"


def test_lerobot_rollout_finds_the_frames_by_itself(tmp_path):
    pose = batch()[ENVIRONMENT][0].double().numpy()
    cell, picture = draw_tags(tmp_path, pose)
    changed(fitted(), control_fps=20.0).save_pretrained(tmp_path / "policy")
    done, log = rollout(tmp_path, f"--policy.cell={cell}", f"--robot.picture={picture}")
    assert done.returncode == 0, done.stderr
    sent = torch.tensor([list(action.values()) for action in json.loads(log.read_text())])
    usual = changed(fitted(), control_fps=20.0)
    one = {key: value[:1] for key, value in batch().items()}
    wanted = torch.cat([usual.select_action(one | {STATE: one[STATE]}) for _ in range(10)])
    # it waits for three pictures
    torch.testing.assert_close(sent[2:8], wanted[:6], rtol=0, atol=0.01)
    assert np.ptp(sent.numpy(), axis=0).max() > 0.05


def test_lerobot_rollout_without_that_camera_says_what_to_do(tmp_path):
    cell, _ = draw_tags(tmp_path, batch()[ENVIRONMENT][0].double().numpy())
    changed(fitted(), control_fps=20.0).save_pretrained(tmp_path / "policy")
    done, _ = rollout(tmp_path, f"--policy.cell={cell}")
    assert done.returncode != 0
    assert "takes the pictures 'observation.images.front', there are []" in done.stderr


def rendered_picture():
    """An environment whose camera sees the bottle, and its cell."""
    env = BottleShakingEnv(fps=20, cameras="front")
    env.reset(seed=3)
    return env, {**env.rig("front").content(), "joints": list(env.joint_names)}


@needs_pictures
def test_poses_of_a_rendered_environment_are_true():
    env, cell = rendered_picture()
    acting = changed(fitted(), control_fps=20.0, cell=cell)
    now, _ = env.reset(seed=3)
    for _ in range(5):
        blind = {k: v for k, v in now.items() if k != "environment_state"}
        seen = preprocess_observation(blind)
        now, *_ = env.step(acting.select_action(seen)[0].numpy())
        [found], true = acting.watch.poses()["bottle"], now["environment_state"]
        np.testing.assert_allclose(found[:3], true[:3], atol=2e-3)
        np.testing.assert_allclose(found[3:], true[3:], atol=0.01)
    assert acting._controller is not None
    env.close()


@needs_pictures
def test_lerobot_eval_looks_through_the_cameras_of_an_environment(tmp_path):
    env, cell = rendered_picture()
    env.close()
    changed(fitted(), control_fps=20.0, cell=cell).save_pretrained(tmp_path / "policy")
    command = (
        "eval", f"--policy.path={tmp_path / 'policy'}", "--env.type=bottle_shaking",
        "--env.fps=20", "--env.episode_length=8", "--env.observe_objects=false",
        "--eval.n_episodes=1", "--eval.batch_size=1",
    )  # fmt: skip
    seen = lerobot(
        *command, "--env.cameras=front", f"--output_dir={tmp_path / 'eval'}", home=tmp_path,
        drawing=offscreen(),
    )  # fmt: skip
    assert seen.returncode == 0, seen.stderr
    assert "holding before the start: robot 0 does not see 'bottle'" in seen.stderr
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    blind = lerobot(*command, f"--output_dir={tmp_path / 'blind'}", home=tmp_path)
    assert blind.returncode != 0
    assert "camera 'front' of the cell takes the pictures" in blind.stderr

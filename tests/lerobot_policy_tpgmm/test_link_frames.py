"""Frames where a link is at an event: in training, and when the policy runs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.policies import grouped
from tests.support.skills import same
from tests.support.training import dataset, epoch, fresh, trained
from tpgmm_control.loop.rollout import rollout
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Canonical, Demonstration, Robot, TaskParameterizedGMM
from tpgmm_torch.alignment import EventAlignment
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.operators.text import parse_operator

pytestmark = pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")

FPS, LENGTH, CLOSINGS = 10, 60, (2.0, 2.4, 1.8, 2.9)
AT_LINKS = {"bottle": "l_hand@close", "start": "l_hand@start"}
OPTIONS = {
    "robot": "upper_body", "links": ["l_hand"], "coordinates": ["l_gripper"],
    "n_components": 3, "random_state": 0, "alignment": "events", "plausibility": "ignore",
}  # fmt: skip
OPERATORS = ["pose:l_hand@bottle + pose:l_hand@start", "canonical"]


def robot():
    return Robot.from_urdf(upper_body_urdf(), ["l_hand"], coordinates=["l_gripper"])


def demonstrate(seed, closing):
    """All joints swing; the gripper closes, if it does."""
    rng, time = np.random.default_rng(seed), np.arange(LENGTH) / FPS
    swing = 0.2 * np.sin(time[:, None] + np.arange(17)) + 0.1 * rng.normal(size=17)
    gripper = np.full(LENGTH, 1.0)
    if closing is not None:
        gripper[(time >= closing) & (time < 5)] = 0.1
    gripper += 0.01 * rng.normal(size=LENGTH)
    joints = np.concatenate([swing, gripper[:, None]], axis=1)
    return Demonstration(time, joints, joint_names=robot().joint_names)


def write_set(path, closings):
    episodes = [demonstrate(seed, closing) for seed, closing in enumerate(closings)]
    return save_lerobot(episodes, path, fps=FPS, task="grip", units={"l_gripper": "raw"})


@pytest.fixture(scope="module")
def grips(tmp_path_factory):
    return dataset(write_set(tmp_path_factory.mktemp("grips") / "set", CLOSINGS))


@pytest.fixture(scope="module")
def policy(grips):
    return trained(grips, link_frames=AT_LINKS, operators=OPERATORS, **OPTIONS)


def test_a_running_policy_is_told_the_object_and_computes_the_start(policy, grips, tmp_path):
    assert policy.frames.frame_names == ("bottle",)
    policy.save_pretrained(tmp_path / "policy")
    [read, *_] = load_lerobot(grips.root, robot=robot(), frames=AT_LINKS)
    bottle = read.frames["bottle"]
    pose = torch.cat((bottle.position, bottle.orientation))
    observation = {"observation.state": read.joints[:1]}
    observation["observation.environment_state"] = pose[None]
    [expected] = rollout(policy.to_estimator().skill, [read], bounds="robot", blend=1.0)
    loaded = TPGMMPolicy.from_pretrained(tmp_path / "policy")
    for one in (policy, loaded, TPGMMPolicy.from_estimator(loaded.to_estimator())):
        one.reset()
        action = one.select_action(observation)
        torch.testing.assert_close(action[0].double(), expected.joints[0], rtol=0, atol=2e-2)
    policy.reset()
    del observation["observation.environment_state"]
    with pytest.raises(DataError, match=r"the pose of 'bottle' is missing.*environment_state"):
        policy.select_action(observation)


def test_operators_that_nobody_names_see_the_frames_too(grips):
    poses, _ = trained(grips, link_frames=AT_LINKS, **OPTIONS).to_estimator().operators_
    assert {"start", "bottle"} <= {*poses.references()}


def test_episodes_without_the_event_are_named(tmp_path):
    data = dataset(write_set(tmp_path / "set", (2.0, None, 1.8, None)))
    learner = fresh(data, link_frames=AT_LINKS, operators=OPERATORS, **OPTIONS)
    with pytest.raises(DataError, match=r"'close', .* is not found in episodes \[1, 3\]"):
        for batch in [*epoch(data, 32), *epoch(data, 32)]:
            learner.forward(batch)


@pytest.mark.parametrize("events", [{}, {"close": "closing:l_gripper"}])
def test_columns_of_events_are_read_from_the_set_unless_a_detector_is_given(tmp_path, events):
    flags = [one + 0.5 for one in CLOSINGS]
    shown = [demonstrate(seed, closing) for seed, closing in enumerate(CLOSINGS)]
    episodes = [replace(d, events={"close": at}) for d, at in zip(shown, flags, strict=True)]
    save_lerobot(episodes, tmp_path / "set", fps=FPS, task="grip", units={"l_gripper": "raw"})
    data = dataset(tmp_path / "set", episodes=[1, 2, 3])
    policy = trained(data, link_frames=AT_LINKS, events=events, operators=OPERATORS, **OPTIONS)
    given = {"robot": robot(), "frames": AT_LINKS, "events": events}
    read = load_lerobot(data.root, episodes=[1, 2, 3], **given)
    when = CLOSINGS if events else flags
    assert [one.events["close"] for one in read] == pytest.approx(list(when[1:]), abs=0.11)
    aligned = EventAlignment(robot=robot()).fit_transform(read)
    operators = [parse_operator(OPERATORS[0]), Canonical()]
    model = TaskParameterizedGMM(3, operators, robot(), random_state=0)
    same(policy.to_estimator(), model.fit(aligned), 1e-6)


def test_texts_and_links_that_are_none_are_refused(grips):
    with pytest.raises(DataError, match="LINK@EVENT"):
        TPGMMConfig(device="cpu", **grouped(link_frames={"bottle": "l_hand"}))
    with pytest.raises(DataError, match="cannot be found"):
        TPGMMConfig(device="cpu", **grouped(events={"close": "l_gripper"}))
    with pytest.raises(UnknownNameError, match=r"'foot'.*l_hand"):
        fresh(grips, link_frames={"bottle": "foot@close"}, **OPTIONS)

"""What a policy learns from the batches of a training loop: the demonstrations, by EM."""

import logging

import numpy as np
import pytest
import torch

from tests.support.errands import HAND
from tests.support.policies import act, loaded, seen
from tests.support.skills import HANDLING, HANDS, same
from tests.support.training import (
    FPS,
    HANDLINGS,
    NAMES,
    WAVES,
    dataset,
    epoch,
    fresh,
    resumed,
    slow_waves,
    trained,
)
from tests.support.two_ways import ARM, Handles, another_handle_each, tip, two_ways_set
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_torch import Frame, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping, EventAlignment, LinearTimeNormalization
from tpgmm_torch.exceptions import DataError, NotFittedError, PlausibilityWarning
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.persistence import encode
from tpgmm_torch.robots.kinematics import JointSpace
from tpgmm_torch.structure.fit_parts import fit_parts
from tpgmm_torch.structure.segmentation import Segmentation

# What is learned


@pytest.mark.parametrize(
    ("alignment", "aligner"),
    [
        ("dtw", DynamicTimeWarping()),
        ("barycenter", DynamicTimeWarping("barycenter")),
        ("linear", LinearTimeNormalization()),
        ("none", None),
    ],
)
@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_an_epoch_of_batches_is_what_the_estimator_learns(waves, alignment, aligner):
    demonstrations = load_lerobot(waves.root)
    if aligner is not None:
        demonstrations = aligner.fit_transform(demonstrations)
    model = TaskParameterizedGMM(**WAVES).fit(demonstrations)
    policy = trained(waves, alignment=alignment, **WAVES)
    same(policy.to_estimator(), model, 1e-12)
    assert torch.equal(policy.to_estimator().time_, model.time_)
    assert policy.config.fps == FPS


def test_frames_and_quaternions_are_learned(handlings):
    demonstrations = DynamicTimeWarping(robot=HANDS).fit_transform(load_lerobot(handlings.root))
    options = {"n_components": 5, "operators": list(HANDLING), "robot": HANDS}
    model = TaskParameterizedGMM(**options).fit(demonstrations)
    policy = trained(handlings, **HANDLINGS)
    same(policy.to_estimator(), model, 1e-9)
    [one], [other] = (m.predict(demonstrations[:1]) for m in (policy.to_estimator(), model))
    torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=1e-6)


# Structure that is found


FOUND = {"n_components": 6, "robot": encode(HAND)}


def test_parts_are_found_and_learned(errand_set, caplog, tmp_path):
    """As tpgmm fit --parts auto --alignment parts does; the skill then stays."""
    operators = ["position:hand@cup", "position:hand@tray", "canonical"]
    shown = load_lerobot(errand_set.root)
    segmentation = Segmentation(HAND)
    divided = segmentation.fit_transform(shown)
    aligned = EventAlignment(["part *"], robot=HAND).fit_transform(divided)
    model = TaskParameterizedGMM(6, list(map(parse_operator, operators)), HAND)
    wanted = fit_parts(model, aligned, Segmentation(HAND).fit(aligned).times())
    options = FOUND | {"operators": operators, "alignment": "parts", "robust": False}
    with caplog.at_level(logging.INFO):
        policy = trained(errand_set, parts="auto", **options)
    assert len(wanted.skills) == 2 and "because of" in caplog.text
    policy.save_pretrained(tmp_path)
    loss, _ = policy.train().forward(epoch(errand_set, 32)[0])
    assert loss.item() == 0 and "more steps change nothing" in caplog.text
    for one in (policy, type(policy).from_pretrained(tmp_path)):
        for part, expected in zip(one.skill.skills, wanted.skills, strict=True):
            assert part.end == expected.end
            torch.testing.assert_close(part.log_weights, expected.log_weights)
    state = {"observation.state": shown[0].joints[:1].float()}
    poses = [torch.cat((f.position, f.orientation)) for f in shown[0].frames.values()]
    state["observation.environment_state"] = torch.cat(poses)[None].float()
    actions = act(one, state, 5)
    torch.testing.assert_close(actions, act(policy.eval(), state, 5))
    resumed(tmp_path, errand_set).forward(epoch(errand_set, 32)[0])


def test_parts_can_be_given(waves):
    aligned = LinearTimeNormalization().fit_transform(load_lerobot(waves.root))
    wanted = fit_parts(TaskParameterizedGMM(**WAVES), aligned, [0.5, 1.2])
    policy = trained(waves, alignment="linear", parts="0.5, 1.2", robust=False, **WAVES)
    ends = [one.end for one in policy.skill.skills]
    assert ends == [one.end for one in wanted.skills]


def test_operators_and_components_are_found(errand_set, tmp_path):
    options = {"robot": encode(HAND), "alignment": "linear"}
    found = trained(errand_set, operators=["auto"], n_components="auto", **options)
    found.save_pretrained(tmp_path)
    again = type(found).from_pretrained(tmp_path)
    same(again.to_estimator(), found.to_estimator())
    assert again.config.n_components == "auto" and again.config.operators == ["auto"]
    assert {"cup", "tray"} == {*again.skill.frame_names}
    with pytest.raises(DataError, match="one at a time"):
        fresh(errand_set, parts="auto", modes=2, **options)


# one object is out of reach of one of the ways
@pytest.mark.filterwarnings("ignore:.*one thing is implausible")
def test_several_ways_are_found_and_each_robot_goes_the_one_that_suits(tmp_path):
    data = dataset(two_ways_set(tmp_path) / "set")
    policy = trained(
        data, robot=encode(ARM), operators=["position:tip@object", "canonical"],
        n_components=8, alignment="none", modes="auto",
    )  # fmt: skip
    assert len(policy.skill.skills) == 2
    policy.save_pretrained(tmp_path / "policy")
    again = type(policy).from_pretrained(tmp_path / "policy")
    given = another_handle_each()
    [one, other] = again.skill.choose(
        torch.stack([each.joints for each in given]),
        {"object": Frame(*(
            torch.stack([getattr(each.frames["object"], name) for each in given])
            for name in ("position", "orientation")
        ))},
    )  # fmt: skip
    assert {one.way, other.way} == {0, 1}
    observed = seen(given)
    for _ in range(75):
        observed["observation.state"] = again.select_action(observed)
    for joints, situation in zip(observed["observation.state"].double(), given, strict=True):
        handles = Handles().handles(situation.frames["object"])
        assert float((tip(joints) - handles).norm(dim=-1).min()) < 0.015


def test_commands_are_learned_beside_measured_joints(commanded, caplog):
    options = {**WAVES, "alignment": "linear"}
    aligned = LinearTimeNormalization().fit_transform(
        load_lerobot(commanded.root, robot=JointSpace(NAMES))
    )
    model = TaskParameterizedGMM(**WAVES).fit(aligned)
    caplog.set_level(logging.INFO)
    policy = trained(commanded, **options)
    assert "servos: " in caplog.text and "learn_from" not in caplog.text
    same(policy.to_estimator(), model, 1e-9)
    time = model.time_.numpy()
    gaps = zip(policy.skill.command_gaps(time), model.skill.command_gaps(time), strict=True)
    assert all(np.allclose(one, other, atol=1e-6) for one, other in gaps)
    again = trained(commanded, learn_from="commanded", **options)
    assert caplog.text.count("commands are learned beside measured joints now") == 1
    same(again.to_estimator(), model, 1e-9)
    assert again.config.training.learn_from is None


def test_actions_that_are_no_postures_are_not_learned_and_said(tmp_path):
    shown = slow_waves()
    steps = [torch.diff(one.joints, dim=0, append=one.joints[-1:]) for one in shown]
    save_lerobot(shown, tmp_path / "set", fps=FPS, task="wave", actions=steps)
    with pytest.warns(PlausibilityWarning, match="'action' holds differences from step to"):
        policy = trained(dataset(tmp_path / "set"), alignment="linear", **WAVES)
    assert policy.skill.command_gaps(np.zeros(1)) is None


# What is said


def test_episodes_that_are_held_out_are_not_learned(waves):
    held_out = dataset(waves.root, [1, 3])
    policy = fresh(dataset(waves.root, [0, 2]), alignment="linear", **WAVES)
    for batch in epoch(dataset(waves.root, [0, 2]), 16):
        policy.forward(batch)
    policy.eval()
    assert all(policy.forward(batch)[0] == 0 for batch in epoch(held_out, 16))
    aligned = LinearTimeNormalization().fit_transform(load_lerobot(waves.root, episodes=[0, 2]))
    same(policy.to_estimator(), TaskParameterizedGMM(**WAVES).fit(aligned), 1e-12)


# When it is learned


def test_the_fit_comes_when_a_frame_comes_again(waves):
    policy = fresh(waves, **WAVES)
    for batch in epoch(waves, 32):
        loss, _ = policy.forward(batch)
        assert loss == 0
        with pytest.raises(NotFittedError):
            policy.to_estimator()
    loss, _ = policy.forward(epoch(waves, 32, seed=1)[0])
    assert loss == 0 and len(policy.to_estimator().weights_) == WAVES["n_components"]


def test_evaluating_and_saving_fit_too(waves, tmp_path):
    for end in (lambda policy: policy.eval(), lambda policy: policy.save_pretrained(tmp_path)):
        policy = fresh(waves, **WAVES)
        for batch in epoch(waves, 32):
            policy.forward(batch)
        end(policy)
        assert policy.to_estimator().n_demonstrations_ == 4
    same(type(policy).from_pretrained(tmp_path).to_estimator(), policy.to_estimator())


def test_a_fitted_policy_stays_as_it_is(waves, tmp_path, caplog):
    policy = trained(waves, **WAVES)
    policy.save_pretrained(tmp_path)
    again = resumed(tmp_path, waves)
    preset = again.config.get_optimizer_preset()
    optimizer = preset.build(again.get_optim_params())
    for batch in epoch(waves, 32, seed=1) * 2:
        loss, _ = again.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(again.parameters(), preset.grad_clip_norm)
        optimizer.step()
    assert loss == 0 and caplog.text.count("more steps change nothing") == 1
    same(again.to_estimator(), policy.to_estimator(), 0)


@pytest.mark.parametrize("given", [{"loss": "imitation"}, {"optimizer_lr": 1e-3}])
def test_options_of_steps_by_gradient_are_refused(waves, given):
    with pytest.raises(DataError, match=r"--policy\.training\.\w+: .* EM alone .* Leave"):
        fresh(waves, **given, **WAVES)


def test_too_few_steps_are_refused_with_the_number_needed(waves, tmp_path):
    policy = fresh(waves, **WAVES)
    with pytest.raises(DataError, match="no frame has come yet"):
        policy.save_pretrained(tmp_path)
    for batch in epoch(waves, 10)[:-1]:
        policy.forward(batch)
    needed = r"120 of the 123 frames of 4 episodes .* batch_size=10 .* at least 13 steps"
    with pytest.raises(DataError, match=needed + ".*--steps"):
        policy.save_pretrained(tmp_path)
    policy.eval()
    with pytest.raises(NotFittedError, match=needed + ".*--eval_steps"):
        policy.forward(epoch(waves, 10)[0])
    policy.train().forward(epoch(waves, 10)[-1])
    policy.save_pretrained(tmp_path)


# What is refused


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_frames_in_order_are_refused(waves):
    policy = fresh(waves, **WAVES)
    rows = torch.utils.data.default_collate([waves[i] for i in range(28)])
    policy.forward(rows)
    policy.eval()  # the first episode is complete
    policy.train()
    with pytest.raises(DataError, match=r"episodes \[1\] came after .* shuffle"):
        policy.forward(torch.utils.data.default_collate([waves[i] for i in range(28, 40)]))


def test_several_processes_are_refused(waves, monkeypatch):
    policy, [batch, *_] = fresh(waves, **WAVES), epoch(waves, 10)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    with pytest.raises(DataError, match=r"one process, this run has 2.*--num_processes=1"):
        policy.forward(batch)


def test_a_policy_that_knows_no_data_set_cannot_be_trained(waves, tmp_path):
    trained(waves, **WAVES).save_pretrained(tmp_path)
    policy = type(fresh(waves, **WAVES)).from_pretrained(tmp_path)
    with pytest.raises(DataError, match="dataset_meta="):
        policy.forward(epoch(waves, 10)[0])


def test_orientations_in_tangent_space_are_learned_kept_and_followed(handlings, tmp_path):
    """Their mean path is part of the configuration once it is found."""
    text = "pose[tangent]:left@cup + pose[tangent]:right@cup"
    policy = trained(handlings, **(HANDLINGS | {"operators": [text]}))
    skill = policy.to_estimator()
    assert all(o.path for o in skill.operators_[0].operators if hasattr(o, "path"))
    policy.save_pretrained(tmp_path)
    again = loaded(tmp_path, ds_meta=handlings.meta)
    assert again.to_estimator().operators_ == skill.operators_
    shown = load_lerobot(handlings.root)
    found = again.to_estimator().score_samples(shown)
    np.testing.assert_allclose(found, skill.score_samples(shown), rtol=1e-9)

"""A model on a GPU gives the figures of one on the processor."""

import numpy as np
import pytest
import torch

from tests.support.skills import bottle_model, few_bottles, handlings, hands_model
from tpgmm_control import Controller
from tpgmm_control.loop.rollout import rollout
from tpgmm_torch import Situation, TaskParameterizedGMM, load, save

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
    ),
]


def learn_on(device: str) -> TaskParameterizedGMM:
    # beyond convergence rounding decides how covariances are regularised: EM stops before
    return bottle_model(8, device=device).fit(few_bottles())


@pytest.fixture(scope="module")
def reference() -> TaskParameterizedGMM:
    return learn_on("cpu")


@pytest.mark.parametrize("device", DEVICES)
def test_learning_and_reproducing_are_the_same_on_each_device(device, reference, tmp_path):
    model = learn_on(device)
    for one, other in zip(learned_tensors(model), learned_tensors(reference), strict=True):
        assert one.device.type == device
        torch.testing.assert_close(one.cpu(), other, rtol=1e-6, atol=1e-8)
    situations = [Situation.of(shown) for shown in few_bottles()[:2]]
    for made, expected in zip(
        model.predict(situations), reference.predict(situations), strict=True
    ):
        torch.testing.assert_close(made.joints.cpu(), expected.joints, rtol=0, atol=1e-6)
        assert made.joints.device.type == device
    assert model.score(few_bottles()) == pytest.approx(reference.score(few_bottles()), abs=1e-5)
    save(model, tmp_path / "model")
    again = load(tmp_path / "model", device="cpu")
    torch.testing.assert_close(again.means_[0], model.means_[0].cpu(), rtol=0, atol=0)


@pytest.mark.parametrize("device", DEVICES)
def test_controllers_and_bounded_references_run_on_each_device(device, reference):
    model, shown = learn_on(device), few_bottles()[1]
    situation = Situation.of(shown)
    [bounded] = rollout(model.skill, [situation], bounds="robot", blend=1.0)
    [expected] = rollout(reference.skill, [situation], bounds="robot", blend=1.0)
    torch.testing.assert_close(bounded.joints.cpu(), expected.joints, rtol=0, atol=1e-5)
    joints = shown.joints[0].to(device)
    controller = Controller(model.skill, joints, situation.frames)
    for _ in range(20):
        command = controller.step(0.1, joints=controller.reference, frames=situation.frames)
        assert bool(command.reference.isfinite().all())
    assert float(controller.time) > 1.0


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_of_robots_steps_on_each_device(device, reference):
    model, shown = learn_on(device), few_bottles()[0]
    rng = np.random.default_rng(0)
    starts = torch.from_numpy(rng.normal(shown.joints[0].cpu(), 0.05, (600, 17)))
    time = torch.from_numpy(rng.uniform(0.0, float(shown.time[-1]), 600))
    made = model.skill.estimate(time.to(device), starts.to(device), shown_frames(shown, device))
    expected = reference.skill.estimate(time, starts, shown_frames(shown, "cpu"))
    torch.testing.assert_close(made.joints.cpu(), expected.joints, rtol=0, atol=1e-6)
    assert made.covariance.device.type == device


@pytest.mark.parametrize("device", DEVICES)
def test_tracked_hands_are_learned_on_each_device(device):
    model = hands_model(device=device, dtype="float32").fit(handlings())
    assert model.means_[0].device.type == device
    assert model.means_[0].dtype == torch.float32
    assert np.isfinite(model.score(handlings()))


def learned_tensors(model: TaskParameterizedGMM) -> list[torch.Tensor]:
    return [model.weights_, *model.means_, *model.covariances_]


def shown_frames(shown, device: str):
    like = torch.zeros((), dtype=torch.float64, device=device)
    return {name: frame.to(like) for name, frame in shown.frames.items()}

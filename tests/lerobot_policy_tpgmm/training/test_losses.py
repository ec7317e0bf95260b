"""Training by gradient from the EM solution: the losses, and what comes of them."""

from dataclasses import replace
from itertools import cycle, islice

import pytest
import torch

from tests.support.policies import act
from tests.support.skills import handlings as handlings_of
from tests.support.skills import same
from tests.support.training import (
    FPS,
    HANDLINGS,
    WAVES,
    dataset,
    epoch,
    fresh,
    resumed,
    trained,
)
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.training.local_data import local_data

LOSSES = ("likelihood", "imitation")


def gradient(policy, batch) -> dict[str, torch.Tensor]:
    policy.zero_grad()
    policy.forward(batch)[0].backward()
    return {name: p.grad.clone() for name, p in policy.named_parameters()}


def value(policy, batch) -> float:
    return policy.forward(batch)[0].item()


def whole(data) -> dict:
    """All frames as one batch."""
    return epoch(data, len(data))[0]


# The gradient is that of the loss


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("fusion", ["information", "covariance"])
def test_gradients_equal_finite_differences(handlings, loss, fusion):
    options = {**HANDLINGS, "covariance_shrinkage": 0.0}
    policy = trained(handlings, loss=loss, fusion=fusion, activation="product", **options)
    batch = epoch(handlings, 16)[0]
    slopes = gradient(policy.train(), batch)
    generator = torch.Generator().manual_seed(0)
    for name, parameter in policy.named_parameters():
        direction = torch.randn(parameter.shape, dtype=torch.float64, generator=generator)
        # of fourth order, so that steps can be long and rounding does not count: on some
        # processors the loss of imitation is rounded by 1e-9, which steps of 1e-4 make 1e-5
        step, near = (1e-3 if loss == "imitation" else 1e-4), {}
        for steps in (-2, -1, 1, 2):
            with torch.no_grad():
                parameter.add_(steps * step * direction)
                near[steps] = value(policy, batch)
                parameter.sub_(steps * step * direction)
        expected = (8 * (near[1] - near[-1]) - (near[2] - near[-2])) / (12 * step)
        slope = float((slopes[name] * direction).sum())
        scale = float(slopes[name].norm() * direction.norm())
        assert scale > 0 and abs(slope - expected) < 1e-5 * scale, name


# EM's solution


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_the_solution_of_em_is_stationary(waves, monkeypatch):
    options = {**WAVES, "alignment": "none", "responsibilities": "point"}
    options["covariance_shrinkage"] = 0.0
    policy = trained(waves, tol=1e-13, max_iter=5000, **options).train()
    slopes = gradient(policy, whole(waves))
    assert max(slope.abs().max() for slope in slopes.values()) < 1e-9
    # for the likelihood alone, regularised covariances are too large
    monkeypatch.setattr(policy._learner, "prior", None)
    slopes = gradient(policy, whole(waves))
    factors = slopes.pop("mixture.factors.0")
    assert max(slope.abs().max() for slope in slopes.values()) < 1e-9
    assert (factors.diagonal(dim1=-2, dim2=-1).sum(-1) > 1e-3).all()


POINTS = {**HANDLINGS, "alignment": "none", "responsibilities": "point"}


def test_shrunken_covariances_are_most_probable(handlings):
    policy = trained(
        handlings, **POINTS | {"n_components": 1, "covariance_shrinkage": 0.3}
    ).train()
    slopes = gradient(policy, whole(handlings))
    assert max(slope.abs().max() for slope in slopes.values()) < 1e-8
    for strength in policy._learner.prior.strengths:
        assert strength.item() == pytest.approx(3 / 7)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_what_em_left_out_is_not_learned_by_gradient(tmp_path):
    shown = handlings_of(6, length=31)
    cup = shown[2].frames["cup"]
    shown[2] = replace(shown[2], frames={"cup": Frame(cup.position + 0.3, cup.orientation)})
    save_lerobot(shown, tmp_path / "set", fps=FPS, task="handle")
    data = dataset(tmp_path / "set")
    for robust in (True, False):
        policy = trained(data, robust=robust, **POINTS).train()
        batch = whole(data)
        wrong = batch["episode_index"].flatten() == 2
        parts = [
            {k: v[rows] if isinstance(v, torch.Tensor) else v for k, v in batch.items()}
            for rows in (wrong, ~wrong)
        ]
        losses = [value(policy, part) for part in parts]
        if robust:
            assert losses[0] == 0 and value(policy, batch) == pytest.approx(losses[1])
        else:
            assert losses[0] != 0 and value(policy, batch) != pytest.approx(losses[1])


def test_the_loss_is_the_log_density_that_em_raises(handlings):
    policy = trained(handlings, alignment="none", **HANDLINGS)
    model, shown = policy.to_estimator(), load_lerobot(handlings.root)
    expected = model.skill.expect
    rows = torch.cat(local_data(shown, model.operators_, model.kinematics_, expected))
    loss = value(policy, whole(handlings))
    assert loss == pytest.approx(-model.mixture_.score(rows.numpy()), rel=1e-9)


# Training goes down, and is what the policy then does


def train(policy, batches: list[dict], steps: int) -> list[float]:
    """As lerobot-train does it, with the preset of the configuration."""
    preset = policy.config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())
    values = []
    for batch in islice(cycle(batches), steps):
        policy.train()
        loss, _ = policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()
        values.append(loss.item())
    return values


def test_the_imitation_error_falls_and_the_policy_acts_on_it(handlings, tmp_path):
    options = {**HANDLINGS, "loss": "imitation", "n_components": 3}
    untrained = trained(handlings, **options)
    policy = fresh(handlings, optimizer_lr=1e-3, **options)
    assert train(policy, epoch(handlings, 32), 60)[:4] == [0.0] * 4
    batch = whole(handlings)
    error, before = (value(one.eval(), batch) for one in (policy, untrained))
    assert error < 0.9 * before
    start = {k: v[:1] for k, v in batch.items() if k.startswith("observation")}
    action, other = (act(one, start, 3) for one in (policy, untrained))
    assert not torch.equal(action, other)
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    assert torch.equal(act(loaded, start, 3), action)
    same(loaded.to_estimator(), policy.to_estimator())


@pytest.mark.parametrize("loss", LOSSES)
def test_a_run_that_is_resumed_goes_on_where_it_was(handlings, tmp_path, loss):
    policy = trained(handlings, loss=loss, **HANDLINGS).train()
    policy.save_pretrained(tmp_path)
    again = resumed(tmp_path, handlings)
    for batch in epoch(handlings, 32, seed=1):
        assert value(again, batch) == 0
    batch = epoch(handlings, 32, seed=2)[0]
    assert value(again, batch) == pytest.approx(value(policy, batch), rel=1e-9)
    same(again.to_estimator(), policy.to_estimator(), 1e-12)


def test_what_is_not_finite_is_refused(waves, tmp_path):
    policy = trained(waves, **WAVES).train()
    batch = epoch(waves, 16)[0]
    with torch.no_grad():
        policy.mixture.means[0][0, 0] = torch.inf
    with pytest.raises(DataError, match=r"the likelihood loss is .*optimizer_lr"):
        policy.forward(batch)
    with pytest.raises(DataError, match=r"means\.0"):
        policy.save_pretrained(tmp_path)
    assert not (tmp_path / "config.json").exists()


def test_frames_are_those_of_the_beginning(handlings):
    # a cup that is carried away: its pose now is not where the skill's frame is
    policy = trained(handlings, follow_frames=False, **HANDLINGS).train()
    batch = epoch(handlings, 32)[0]
    poses = batch["observation.environment_state"].clone()
    poses[:, :3] += 0.5 * (batch["timestamp"].reshape(-1, 1) > 0)
    carried = {**batch, "observation.environment_state": poses}
    loss = value(policy, batch)
    assert value(policy, carried) == loss
    policy.config.control.follow_frames = True
    assert value(policy, batch) == loss != value(policy, carried)

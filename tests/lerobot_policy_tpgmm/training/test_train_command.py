"""``lerobot-train`` with a tpgmm policy, in a process of its own."""

import re

import pytest
import torch

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.lerobot_commands import lerobot
from tests.support.skills import same
from tests.support.worlds import upper_body
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

pytestmark = pytest.mark.slow

RATE, BATCH, K = 10, 128, 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set of five episodes, the last of which is held out."""
    path = tmp_path_factory.mktemp("train")
    demonstrations = BottleShaking(rate=RATE, robot=upper_body()).demonstrations(5)
    save_lerobot(demonstrations, path / "set", fps=RATE, task="shake")
    return path


@pytest.fixture(scope="module")
def demonstrations(folder):
    return load_lerobot(folder / "set", robot=upper_body())


@pytest.fixture(scope="module")
def n_steps(demonstrations):
    """Of an epoch."""
    return -(-sum(map(len, demonstrations[:4])) // BATCH)


def train(folder, *arguments: str) -> str:
    """What is logged."""
    done = lerobot("train", "--log_freq=1", *arguments, home=folder)
    assert done.returncode == 0, done.stderr
    return done.stderr


def logged(log: str, name: str) -> list[float]:
    return [float(value) for value in re.findall(rf"\b{name}[:=](-?[\d.]+|nan|inf)", log)]


def saved(folder, step: int, output: str = "out") -> TPGMMPolicy:
    checkpoint = folder / output / "checkpoints" / f"{step:06d}"
    return TPGMMPolicy.from_pretrained(checkpoint / "pretrained_model")


@pytest.fixture(scope="module")
def log(folder, n_steps):
    """The first epoch, then as many steps by gradient; checkpoints and losses after both."""
    return train(
        folder, "--policy.type=tpgmm", "--policy.robot=upper_body", "--policy.device=cpu",
        f"--policy.n_components={K}", "--policy.training.loss=imitation", "--num_workers=0",
        "--dataset.repo_id=local/shake", f"--dataset.root={folder / 'set'}",
        "--dataset.eval_split=0.2", f"--batch_size={BATCH}", f"--steps={2 * n_steps}",
        f"--save_freq={n_steps}", f"--eval_steps={n_steps}", f"--output_dir={folder / 'out'}",
    )  # fmt: skip


def test_the_first_epoch_gives_what_the_estimator_learns(folder, log, demonstrations, n_steps):
    learned, held_out = demonstrations[:4], demonstrations[4:]
    aligned = DynamicTimeWarping(robot=upper_body()).fit_transform(learned)
    model = TaskParameterizedGMM(K, bottle_operators(), upper_body()).fit(aligned)
    policy = saved(folder, n_steps)
    same(policy.to_estimator(), model, 1e-9)
    [one], [other] = (m.predict(held_out) for m in (policy.to_estimator(), model))
    torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=1e-5)
    assert policy.config.fps == RATE
    frames = sum(map(len, learned))
    for said in (f"{frames} frames of 4 episodes collected", f"{K} components fitted by"):
        assert said in log
    assert logged(log, "loss")[:n_steps] == [0.0] * n_steps


def test_then_the_loss_falls_by_gradient(folder, log, n_steps):
    losses = logged(log, "loss")[n_steps:]
    assert len(losses) == n_steps and min(losses) > 0
    before, after = logged(log, "eval_loss")
    assert after < before
    fitted, trained = (saved(folder, step).to_estimator() for step in (n_steps, 2 * n_steps))
    change = (trained.means_[0] - fitted.means_[0]).abs().max()
    assert 1e-4 < change < 1e-4 * 1.01 * n_steps  # Adam's steps are of the size optimizer_lr


def test_a_run_is_resumed(folder, log, n_steps):
    end = 2 * n_steps + n_steps + 2
    checkpoint = folder / "out" / "checkpoints" / "last" / "pretrained_model"
    resumed = train(
        folder, f"--config_path={checkpoint / 'train_config.json'}", "--resume=true",
        f"--steps={end}", "--eval_steps=1",
    )  # fmt: skip
    losses = logged(resumed, "loss")
    # the frames are collected anew, which changes nothing, and then it goes on
    assert losses[:n_steps] == [0.0] * n_steps and min(losses[n_steps:]) > 0
    held_out = logged(resumed, "eval_loss")
    assert set(held_out[:n_steps]) == {logged(log, "eval_loss")[-1]}
    assert held_out[-1] < held_out[0]
    assert "components fitted" not in resumed
    saved(folder, end)

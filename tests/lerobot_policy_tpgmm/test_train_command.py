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


def read_figures(log: str, name: str) -> list[float]:
    return [float(value) for value in re.findall(rf"\b{name}[:=](-?[\d.]+|nan|inf)", log)]


def load_checkpoint(folder, step: int, output: str = "out") -> TPGMMPolicy:
    checkpoint = folder / output / "checkpoints" / f"{step:06d}"
    return TPGMMPolicy.from_pretrained(checkpoint / "pretrained_model")


@pytest.fixture(scope="module")
def log(folder, n_steps):
    """An epoch and a step more; checkpoints and losses of held-out frames after both."""
    return train(
        folder, "--policy.type=tpgmm", "--policy.robot=upper_body", "--policy.device=cpu",
        f"--policy.n_components={K}", "--num_workers=0",
        "--dataset.repo_id=local/shake", f"--dataset.root={folder / 'set'}",
        "--dataset.eval_split=0.2", f"--batch_size={BATCH}", f"--steps={n_steps + 1}",
        f"--save_freq={n_steps}", f"--eval_steps={n_steps}", f"--output_dir={folder / 'out'}",
    )  # fmt: skip


def test_the_first_epoch_gives_what_the_estimator_learns(folder, log, demonstrations, n_steps):
    learned, held_out = demonstrations[:4], demonstrations[4:]
    aligned = DynamicTimeWarping(robot=upper_body()).fit_transform(learned)
    model = TaskParameterizedGMM(K, bottle_operators(), upper_body()).fit(aligned)
    policy = load_checkpoint(folder, n_steps)
    same(policy.to_estimator(), model, 1e-9)
    [one], [other] = (m.predict(held_out) for m in (policy.to_estimator(), model))
    torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=1e-5)
    assert policy.config.fps == RATE
    frames = sum(map(len, learned))
    for said in (f"{frames} frames of 4 episodes collected", f"{K} components fitted by"):
        assert said in log
    assert set(read_figures(log, "loss")) == set(read_figures(log, "eval_loss")) == {0.0}


def test_more_steps_and_a_resumed_run_change_nothing(folder, log, n_steps):
    assert log.count("more steps change nothing") == 1
    end = n_steps + 3
    checkpoint = folder / "out" / "checkpoints" / "last" / "pretrained_model"
    resumed = train(
        folder, f"--config_path={checkpoint / 'train_config.json'}", "--resume=true",
        f"--steps={end}", "--eval_steps=1",
    )  # fmt: skip
    losses = (set(read_figures(resumed, name)) for name in ("loss", "eval_loss"))
    assert [*losses] == [{0.0}] * 2
    assert "more steps change nothing" in resumed and "components fitted" not in resumed
    fitted = load_checkpoint(folder, n_steps).to_estimator()
    for step in (n_steps + 1, end):
        same(load_checkpoint(folder, step).to_estimator(), fitted, 0)


def test_options_that_went_are_refused_in_words(folder):
    done = lerobot(
        "train", "--policy.type=tpgmm", "--policy.robot=upper_body", "--policy.device=cpu",
        "--policy.training.loss=imitation", "--num_workers=0", "--policy.push_to_hub=false",
        "--dataset.repo_id=local/shake", f"--dataset.root={folder / 'set'}",
        f"--output_dir={folder / 'refused'}", home=folder,
    )  # fmt: skip
    assert done.returncode and "--policy.training.loss: lerobot-train fits by EM" in done.stderr

"""``tpgmm fit`` in batches, with checkpoints, and by two processes under torchrun."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.support.command_line import output, refusal
from tests.support.skills import waves
from tpgmm_datasets import save_lerobot
from tpgmm_torch import Demonstration

FIT = ("--alignment", "linear", "--n-components", 4, "--tol", "1e-6")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Five episodes of three joints, of unequal length."""
    shown = [
        Demonstration(np.arange(40 - i) / 20, d.joints[: 40 - i], joint_names=("a", "b", "c"))
        for i, d in enumerate(waves(5, length=40))
    ]
    path = tmp_path_factory.mktemp("large") / "set"
    return Path(save_lerobot(shown, path, fps=20, task="wave"))


def assert_same(one: Path, other: Path, tolerance: float = 1e-9) -> None:
    found, expected = (load_file(path / "model.safetensors") for path in (one, other))
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_one_batch_of_all_is_the_whole(dataset, tmp_path):
    whole, batched = tmp_path / "whole", tmp_path / "batched"
    output("fit", dataset, *FIT, "--out", whole)
    printed = output("fit", dataset, *FIT, "--batch-episodes", 5, "--out", batched)
    assert_same(batched, whole)
    assert "demonstrations   5 of 1.75 to 1.95 s" in printed
    assert "bound of EM" in printed
    output("fit", dataset, *FIT, "--batch-episodes", 2, "--out", tmp_path / "other")


@pytest.mark.filterwarnings("ignore:EM did not converge")
def test_a_fit_is_prolonged_from_its_checkpoint(dataset, tmp_path):
    state, whole, parts = tmp_path / "em", tmp_path / "whole", tmp_path / "parts"
    fit = ("fit", dataset, *FIT[:-2], "--tol", 0)
    keep = ("--checkpoint", state, "--checkpoint-every", 2, "--out", parts)
    output(*fit, "--max-iter", 9, "--out", whole)
    assert "resumed" not in output(*fit, "--max-iter", 4, *keep)
    printed = output(*fit, "--max-iter", 9, *keep)
    assert f"resumed          {state}, after 4 iterations" in printed
    assert_same(parts, whole)
    line = refusal(*fit, "--max-iter", 9, "--random-state", 3, *keep)
    assert "of another fit: random_state was 0 and is 3" in line


def test_two_processes_print_and_write_once(dataset, tmp_path):
    alone, together = tmp_path / "alone", tmp_path / "together"
    arguments = [str(part) for part in ("fit", dataset, *FIT, "--batch-episodes", 2)]
    output(*arguments, "--out", alone)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node=2", "--no-python"]
    command += [str(Path(sys.executable).with_name("tpgmm")), *arguments]
    done = subprocess.run(
        [*command, "--out", str(together)],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert_same(together, alone)
    assert done.stdout.count("saved ") == 1
    assert "processes        2" in done.stdout
    assert "demonstrations   5 of 1.75 to 1.95 s" in done.stdout

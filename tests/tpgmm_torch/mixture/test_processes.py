"""Several processes under torchrun: the model of one, and an end with clear words."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from tests.support import torchrun_worker as worker
from tests.support.refusals import refused
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.processes import Processes, joined_processes

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]


def torchrun(*arguments: object, count: int = 2) -> subprocess.CompletedProcess:
    """Start processes that exchange by gloo, and wait for them."""
    paths = [str(ROOT), str(ROOT / "datasets"), str(ROOT / "policies")]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--nproc-per-node={count}", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=ROOT, timeout=300
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What two processes learned, a dict of models for each."""
    folder = tmp_path_factory.mktemp("equal")
    done = torchrun(worker.__file__, "equal", folder)
    assert done.returncode == 0, done.stderr
    return [torch.load(folder / f"found{rank}.pt", weights_only=True) for rank in range(2)]


def alone(name: str) -> dict[str, torch.Tensor]:
    """What one process learns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name in worker.SKILLS:
            demonstrations, settings = worker.SKILLS[name]
            return worker.described(worker.skill(**settings).fit(demonstrations(5)))
        return worker.learned(worker.mixture(**worker.MIXTURES[name]).fit(worker.rows()))


@pytest.mark.parametrize("name", [*worker.MIXTURES, *worker.SKILLS])
def test_two_processes_learn_what_one_learns(found, name):
    torch.testing.assert_close(found[0][name], found[1][name], rtol=0, atol=0)
    if name == "seedless":  # there is nothing to compare with but each other
        return
    tolerance = 1e-9 if name != "single" else 1e-4
    torch.testing.assert_close(found[0][name], alone(name), rtol=tolerance, atol=tolerance)


def test_bad_shares_are_refused_by_all_processes(tmp_path):
    done = torchrun(worker.__file__, "refused", tmp_path)
    assert done.returncode == 0, done.stderr
    expected = {
        "empty": "no rows, X is empty in process(es) [1] of 2",
        "columns": "have (5, 4) columns",
        "few": "n_components=9, but the data hold only 3 distinct",
        "none": "X is empty in process(es) [1] of 2",
        "frames": "process 1 has demonstrations with",
        "share": "1 episodes or batches cannot be shared among 2",
    }
    for name, message in expected.items():
        for rank in range(2):
            text = (tmp_path / f"{name}{rank}.txt").read_text()
            assert text.startswith("DataError: "), text
            assert message in text


def test_a_process_that_dies_ends_the_job(tmp_path):
    done = torchrun(worker.__file__, "dies", tmp_path)
    assert done.returncode != 0
    assert not list(tmp_path.glob("model*"))
    error = tmp_path / "error0.txt"
    # torchrun stops the survivor, possibly before it has noticed itself
    if error.exists():
        text = error.read_text()
        assert "DistributedError: another process of this job has stopped" in text
    assert "-9" in done.stderr or "SIGKILL" in done.stderr


def test_without_torchrun_there_is_one_process():
    with joined_processes() as processes:
        assert (processes.rank, processes.count) == (0, 1)
        assert processes.gather("a word, µ") == ["a word, µ"]
        [one] = processes.sum(torch.ones(2))
        assert one.tolist() == [1.0, 1.0]


def test_shares_are_consecutive_and_nearly_equal():
    processes = Processes()
    processes.count = 3
    shares = []
    for processes.rank in range(3):
        shares.append(processes.share("abcdefgh"))
    assert shares == [["a", "b"], ["c", "d", "e"], ["f", "g", "h"]]
    refused(lambda: processes.share("ab"), DataError, r"2 episodes or batches.*3 processes")

"""Saves that are killed, or come at the same time: the old or the new, whole, and none lost."""

import copy
import itertools
import os
import time

import torch

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import skills
from tests.support.damage import FULL
from tests.support.kills import exit_code, forked, killed_between
from tests.support.policies import changed, fitted
from tests.support.written_sets import FPS, assert_same, demonstration
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_torch import atomic, persistence
from tpgmm_torch.persistence import load_model

KILLS = 200 if FULL else 4


def left_alone(path):
    """What a last save leaves beside it: nothing."""
    return [item.name for item in path.parent.iterdir()] == [path.name]


def numbered(path):
    """Give what saves a model of a number, and what loads it, whole, and tells its number."""
    model = copy.deepcopy(skills.hands())
    mean = model.means_[0].clone()

    def save(number):
        model.n_iter_, model.means_[0] = number, mean + number
        persistence.save(model, path)

    def load():
        found = load_model(path)
        assert torch.equal(found.means_[0], mean + found.n_iter_)
        return found.n_iter_

    return save, load


def test_models(tmp_path):
    path = tmp_path / "model"
    save, load = numbered(path)
    killed_between(save, load, KILLS)
    save(10**6)
    assert left_alone(path)


def test_policies(tmp_path):
    path, policy = tmp_path / "policy", changed(fitted(), chunk_size=1)
    model = policy.to_estimator()
    mean = model.means_[0].clone()

    def save(number):
        policy.config.chunk_size = number + 1
        model.means_[0] = mean + number
        policy.save_pretrained(path)

    def load():
        found = TPGMMPolicy.from_pretrained(path)
        number = found.config.chunk_size - 1
        assert torch.equal(found.to_estimator().means_[0], mean + number)
        return number

    killed_between(save, load, KILLS)
    save(10**6)
    assert left_alone(path)


def test_data_sets(tmp_path):
    path = tmp_path / "set"

    def save(number):
        save_lerobot(
            [demonstration(number)], path, fps=FPS, task="reach", append=True, dtype="float64"
        )
        (path / "count").write_text("")  # a file of another hand stays

    def load():
        found = load_lerobot(path)
        kept.append(len(found))
        assert kept[-1] - kept[-2] in (0, 1)
        for episode in found[:1]:
            assert_same(episode, demonstration(0), 0.0)
        return len(found) - 1 if len(kept) < 3 else numbers(found)

    def numbers(found):
        last = found[-1].joints
        return next(n for n in range(2 + KILLS) if torch.equal(demonstration(n).joints, last))

    kept = [1]
    killed_between(save, load, KILLS)
    assert len(load_lerobot(path)) == kept[-1]
    save(0)
    assert left_alone(path) and (path / "count").exists()


def test_processes_that_append_to_one_set_wait_for_each_other(tmp_path):
    path, writers, each = tmp_path / "set", 4, 26 if FULL else 4

    def append(writer):
        for episode in range(each):
            save_lerobot(
                [demonstration(1000 * writer + episode, length=5)], path, fps=FPS,
                task="reach", append=True, dtype="float64",
            )  # fmt: skip

    pids = [forked(lambda writer=writer: append(writer)) for writer in range(writers)]
    assert [exit_code(pid) for pid in pids] == [0] * writers
    found = [episode.joints for episode in load_lerobot(path)]
    expected = [
        demonstration(1000 * writer + episode, length=5).joints
        for writer in range(writers)
        for episode in range(each)
    ]
    assert len(found) == writers * each
    assert all(any(torch.equal(a, b) for b in found) for a in expected)
    assert left_alone(path)


def test_a_lock_goes_with_its_process(tmp_path):
    path, (read, write) = tmp_path / "set", os.pipe()

    def hold():
        with atomic.replacing(path) as new:
            new.mkdir()
            os.write(write, b"!")
            time.sleep(60)

    pid = forked(hold)
    os.read(read, 1)
    os.kill(pid, 9)
    exit_code(pid)
    with atomic.replacing(path) as new:
        new.mkdir()
    assert left_alone(path)


def test_who_reads_while_it_is_saved_has_the_old_or_the_new(tmp_path):
    save, load = numbered(tmp_path / "model")
    enough = tmp_path / "enough"

    def save_on():
        for number in itertools.count(1):
            if enough.exists():
                return
            save(number)

    save(0)
    pid, seen = forked(save_on), set()
    while len(seen) < 5:  # however slowly either of them gets a processor
        seen.add(load())
    enough.touch()
    assert exit_code(pid) == 0


def test_savers_of_one_model_leave_a_whole_one(tmp_path):
    path = tmp_path / "model"
    save, load = numbered(path)

    def save_often(number):
        for _ in range(10):
            save(number)

    pids = [forked(lambda number=number: save_often(number)) for number in range(4)]
    assert [exit_code(pid) for pid in pids] == [0] * 4
    load()
    assert left_alone(path)

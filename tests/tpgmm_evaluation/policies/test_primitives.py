"""Movement primitives: led to key poses that are where they were not shown."""

import sys

import pytest
import torch

from tests.support.learned_sets import aligned, played, recorded, shaking
from tpgmm_evaluation.policies.aligned import Aligned
from tpgmm_evaluation.policies.planned import Observed
from tpgmm_evaluation.policies.primitives import DMPPolicy, ProMPPolicy
from tpgmm_torch.exceptions import DependencyError

KINDS = (DMPPolicy, ProMPPolicy)


@pytest.fixture(scope="module", params=KINDS)
def policy(request):
    return request.param.fit(aligned(shaking()))


def test_the_grasp_is_reached_and_kept_where_the_bottle_is(policy):
    grasp = policy.moves[1]
    for situation in shaking().situations(2, seed=11):
        bottle = situation.frames["bottle"]
        done = played(policy, situation.joints, bottle, steps=grasp.end)
        distance, _ = shaking().grasp_error(done[[grasp.arrive, -1]], bottle)
        assert distance.max() < 3e-3
        assert (done[0] - situation.joints).abs().max() < 0.02


def test_a_promp_passes_through_the_posture_it_is_conditioned_on():
    policy = ProMPPolicy.fit(aligned(shaking()))
    [situation] = shaking().situations(1, seed=12)
    bottle, move = situation.frames["bottle"], policy.moves[0]
    frames = {"bottle": bottle}
    seen = Observed(situation.joints, situation.joints, frames, frames, 0)
    vias, longer = policy.postures(move, seen), policy.references(seen)
    # the last one is that in which the next move begins
    on_the_way = list(zip(move.steps, vias, strict=True))[:-1]
    assert len(on_the_way) >= 2
    for step, posture in on_the_way:
        assert (longer[step] - posture).abs().max() < 1e-4
    via = vias[-1]
    assert (longer[-1] - via).abs().max() < 0.05
    assert (longer[0] - situation.joints).abs().max() < 1e-3
    # without it the mean of the demonstrations would be played
    assert (policy.mean[move.arrive] - via).abs().max() > 0.05


def test_saved_and_from_one_demonstration(tmp_path):
    [situation] = shaking().situations(1, seed=13)
    for kind in KINDS:
        one = kind.fit(Aligned.read(recorded(shaking()), shaking().robot, 1))
        one.save_pretrained(tmp_path / kind.name)
        loaded = kind.from_pretrained(tmp_path / kind.name)
        done, again = (
            played(p, situation.joints, situation.frames["bottle"], steps=20)
            for p in (one, loaded)
        )
        torch.testing.assert_close(done, again)


def test_a_missing_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "movement_primitives.dmp", None)
    with pytest.raises(DependencyError, match=r"tpgmm_evaluation\[compare\]"):
        DMPPolicy.fit(aligned(shaking()))

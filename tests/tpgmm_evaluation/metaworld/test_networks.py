"""Networks on Meta-World's states: without Meta-World."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.support.reaching import reaching
from tpgmm_evaluation.metaworld.learners import LEARNERS, settings_of
from tpgmm_evaluation.metaworld.networks import Perceptron, features

pytestmark = pytest.mark.slow


def test_networks_are_told_where_the_hand_is_as_seen_from_objects():
    [seen] = features(reaching(1).observed[:1], relative=True)
    hand, places, relative = seen[:3], seen[4:13].reshape(3, 3), seen[13:].reshape(3, 3)
    assert np.allclose(places - hand, relative)
    assert np.array_equal(features(reaching(1).observed, relative=False)[0], seen[:13])


def test_the_perceptron_learns_what_it_is_shown():
    shown = [reaching(i) for i in range(5)]
    actor = Perceptron(hidden=(64,), updates=600).fit(shown, 0)
    given = np.array([actor.act(0, t, shown[0].observed[t]) for t in range(5, 55)])
    assert np.abs(given - shown[0].actions[5:55]).mean() < 0.15


@pytest.mark.parametrize(
    ("name", "control"), [("act", "displacement"), ("diffusion", "reference")]
)
def test_networks_learn_what_they_are_shown(name, control):
    learner = replace(LEARNERS[name], control=control, budget=3.0)
    shown, other = [reaching(i) for i in range(5)], reaching(5)
    actor = learner.fit(shown, 0, [other])
    actor.begin(other.observed[:1])
    given = np.array([actor.act(0, t, seen) for t, seen in enumerate(other.observed)])
    wanted = other.references if control == "reference" else other.actions
    assert np.abs(given - wanted).mean() < 0.5 * np.abs(wanted - wanted.mean(0)).mean()


def test_training_ends_when_other_demonstrations_are_told_no_better():
    learner = LEARNERS["act"]
    recipe = replace(learner.recipe, check_every=1, patience=1, falls=0)
    actor = replace(learner, recipe=recipe).fit([reaching(1)], 0, [reaching(2)])
    assert actor.outcome == "the validation error stopped falling"
    errors = [point["validation_error"] for point in actor.training.curve]
    assert errors[-1] > 0.99 * min(errors[:-1])


def test_an_action_holds_until_the_next_step_of_a_slower_network():
    learner = LEARNERS["act"]
    recipe = replace(learner.recipe, rate=20, check_every=5)
    actor = replace(learner, recipe=recipe, budget=0.0).fit([reaching(1)], 0, [reaching(2)])
    seen = reaching(2).observed[:12]
    given = np.array([actor.act(0, step, row) for step, row in enumerate(seen)])
    assert all((given[i] == given[i - i % 4]).all() for i in range(12))
    assert not np.array_equal(given[0], given[4]) and not np.array_equal(given[4], given[8])
    # an episode begins anew
    assert np.array_equal(actor.act(1, 0, seen[0]), given[0])


def test_settings_are_what_their_file_says():
    for learner in LEARNERS.values():
        assert json.loads(json.dumps(settings_of(learner))) == settings_of(learner)
    assert settings_of(LEARNERS["act"])["recipe"]["config"] == "ACTConfig"

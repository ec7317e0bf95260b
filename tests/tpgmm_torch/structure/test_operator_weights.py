"""How much operators count: frames that do not matter do no harm."""

import numpy as np
import pytest
import torch

from tests.support.planted import HAND, NAMES, PlantedTask
from tests.support.skills import handlings, hands_model, waves
from tpgmm_torch import Canonical, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators.text import parse_operator
from tpgmm_torch.structure.operator_weights import weighted

TASK = PlantedTask(1, 2)
SHOWN = TASK.demonstrations(5)
OTHERS = [name for name in NAMES if name not in TASK.relevant]


def model(frames, weights="equal", **options):
    operators = [parse_operator(f"pose:hand@{frame}") for frame in frames]
    options = {"robust": False, "plausibility": "ignore", "blend": 0.0} | options
    return TaskParameterizedGMM(
        12, [*operators, Canonical()], HAND, operator_weights=weights, **options
    )


def error(fitted):
    """Mean distance of the hand from where it is in tasks that were not shown [m]."""
    distances = []
    for truth in TASK.demonstrations(3, seed=1, noise=False):
        frames = {name: truth.frames[name] for name in fitted.frame_names_}
        situation = Situation(truth.joints[0], frames, truth.time)
        [trajectory] = fitted.predict([situation], candidates=False)
        distances.append((trajectory.joints - truth.joints)[:, :3].norm(dim=-1).mean())
    return float(torch.stack(distances).mean())


@pytest.fixture(scope="module")
def fitted():
    return model([*TASK.relevant, *OTHERS[:6]], "held-out").fit(SHOWN)


def test_six_frames_that_do_not_matter_do_no_harm(fitted):
    told = error(model(TASK.relevant).fit(SHOWN))
    harmed = error(model([*TASK.relevant, *OTHERS[:6]]).fit(SHOWN))
    assert error(fitted) < 1.2 * told < harmed


def test_what_matters_counts_most(fitted):
    weights = fitted.operator_weights_
    assert weights.shape == (12, 9) and bool(((weights > 0) & (weights <= 1)).all())
    first, second, *others = weights.mean(0)[:-1].tolist()
    assert first + second > 3 * sum(others) / len(others)


def test_only_what_is_known_given_time_counts_for_less(fitted):
    plain = model([*TASK.relevant, *OTHERS[:6]]).fit(SHOWN)
    assert plain.operator_weights_ is None
    for mean, other in zip(plain.means_, fitted.means_, strict=True):
        assert torch.equal(mean, other)
    given_time, with_weights = (
        torch.stack([one.covariance for one in each.regression().conditionals], 1)
        for each in (plain, fitted)
    )
    expected = given_time / fitted.operator_weights_[:, :, None, None]
    torch.testing.assert_close(with_weights, expected, rtol=1e-8, atol=1e-14)


def test_weights_of_one_change_nothing():
    rng = np.random.default_rng(0)
    roots = torch.from_numpy(rng.normal(size=(3, 4, 4)))
    covariances = roots @ roots.mT + torch.eye(4, dtype=roots.dtype)
    torch.testing.assert_close(weighted(covariances, roots.new_ones(3)), covariances)
    halved = weighted(covariances, roots.new_full((3,), 0.5))
    torch.testing.assert_close(halved[:, 0], covariances[:, 0])


def test_they_are_saved(fitted, tmp_path):
    fitted.save(tmp_path / "model")
    again = TaskParameterizedGMM.load(tmp_path / "model")
    torch.testing.assert_close(again.operator_weights_, fitted.operator_weights_)
    for one, other in zip(again.covariances_, fitted.covariances_, strict=True):
        assert torch.equal(one, other)


def test_they_are_kept_while_learning_goes_on(tmp_path):
    shown, options = handlings(5), {"robust": False, "plausibility": "ignore"}
    plain = hands_model(**options).fit(shown[:4]).partial_fit(shown[4:])
    counted = hands_model(operator_weights="held-out", **options).fit(shown[:4])
    counted.save(tmp_path / "model", demonstrations=True)
    before = counted.operator_weights_
    for again in (counted, TaskParameterizedGMM.load(tmp_path / "model")):
        again.partial_fit(shown[4:])
        torch.testing.assert_close(again.operator_weights_, before)
        for j, (one, other) in enumerate(
            zip(plain.covariances_, again.covariances_, strict=True)
        ):
            torch.testing.assert_close(weighted(one, before[:, j]), other, rtol=1e-6, atol=1e-9)


def test_operators_that_all_matter_all_count():
    fitted = TaskParameterizedGMM(4, operator_weights="held-out").fit(waves(5, 60))
    assert float(fitted.operator_weights_.min()) > 0.85


def test_two_demonstrations_are_too_few():
    with pytest.raises(DataError, match='at least 3, got 2; use operator_weights="equal"'):
        TaskParameterizedGMM(2, operator_weights="held-out").fit(waves(2))


def test_batches_are_refused():
    with pytest.raises(DataError, match='operator_weights="held-out"'):
        TaskParameterizedGMM(2, operator_weights="held-out").fit([waves(2), waves(2)])

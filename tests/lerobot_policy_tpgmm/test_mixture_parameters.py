"""The mixture as torch parameters: equal to the model, and positive definite for ever."""

import pytest
import torch

from lerobot_policy_tpgmm.mixture_parameters import MixtureParameters
from tests.support.skills import (
    HANDLING,
    HANDS,
    canonical,
    handlings,
    hands,
    hands_model,
    same,
    waves,
)
from tests.support.skills import new_handling as situation
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, NotFittedError, ShapeError
from tpgmm_torch.robots.kinematics import JointSpace

DIMENSIONS = [operator.dimension(HANDS) for operator in HANDLING]


def parameters_of(model: TaskParameterizedGMM) -> MixtureParameters:
    widths = [mean.shape[1] - 1 for mean in model.means_]
    made = MixtureParameters(len(model.weights_), widths, dtype=model.weights_.dtype)
    made.copy_from(model)
    return made


@pytest.mark.parametrize("covariance_type", ["full", "diag", "tied", "spherical"])
def test_a_model_comes_back_equal(covariance_type):
    model = hands_model(covariance_type=covariance_type).fit(handlings())
    back = parameters_of(model).to_estimator(
        hands_model(covariance_type=covariance_type), n_demonstrations=model.n_demonstrations_
    )
    same(back, model, 1e-14)
    for j, covariance in enumerate(model.covariances_):
        assert torch.equal(back.means_[j], model.means_[j])
        error = torch.linalg.matrix_norm(back.covariances_[j] - covariance)
        assert (error <= 1e-12 * torch.linalg.matrix_norm(covariance)).all()
    assert torch.equal(back.time_, model.time_)
    assert back.frame_names_ == model.frame_names_ and back.kinematics_ == model.kinematics_
    assert back.score(handlings()) == pytest.approx(model.score(handlings()), rel=1e-9)
    [one], [other] = (m.predict([situation()[0]]) for m in (back, model))
    # the last digit of a covariance, times its condition number
    torch.testing.assert_close(one.joints, other.joints, rtol=0, atol=1e-7)


def test_the_copies_share_no_memory_with_the_model():
    model, back = canonical().fit(waves()), canonical(robot=JointSpace(("a", "b", "c")))
    made = parameters_of(model)
    back = made.to_estimator(back)
    before = model.means_[0].clone()
    with torch.no_grad():
        made.means[0].add_(1.0)
        made.time.add_(1.0)
    assert torch.equal(model.means_[0], before) and torch.equal(back.means_[0], before)
    assert torch.equal(model.time_, back.time_)


def test_gradients_of_the_mixture():
    made = MixtureParameters(2, [2, 1])
    generator = torch.Generator().manual_seed(0)
    values = [
        torch.randn(p.shape, dtype=p.dtype, generator=generator).requires_grad_()
        for p in made.parameters()
    ]
    names = [name for name, _ in made.named_parameters()]

    def mixture(*values):
        given = dict(zip(names, values, strict=True))
        weights, means, covariances = torch.func.functional_call(made, given, ())
        return (weights, *means, *covariances)

    made.forward = made.tensors
    assert torch.autograd.gradcheck(mixture, values)


@pytest.mark.parametrize("step", [1.0, 100.0])
def test_covariances_stay_positive_definite_whatever_the_step(step):
    made = parameters_of(hands())
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for factor in made.factors:
            noise = torch.randn(factor.shape, dtype=factor.dtype, generator=generator)
            factor.add_(step * noise.clamp(-3, 3))
    for triangle in made.triangles():
        assert (triangle.diagonal(dim1=-2, dim2=-1) > 0).all()
    if step == 1.0:
        for covariance in made.tensors()[2]:
            assert not torch.linalg.cholesky_ex(covariance)[1].any()


def test_what_does_not_fit_is_refused():
    with pytest.raises(ShapeError, match=r"\[\(6, 8\), \(6, 8\)\].*asks for \[\(5, 8\)"):
        MixtureParameters(5, DIMENSIONS).copy_from(hands())
    with pytest.raises(NotFittedError, match=r"call fit"):
        MixtureParameters(6, DIMENSIONS).copy_from(hands_model())
    with pytest.raises(NotFittedError, match="the policy is not fitted"):
        MixtureParameters(6, DIMENSIONS).to_estimator(hands_model())
    made = parameters_of(hands())
    with torch.no_grad():
        made.factors[1][0, 0, 0] = torch.nan
    with pytest.raises(DataError, match=r"\['factors.1'\] hold NaN"):
        made.to_estimator(hands_model())
    with pytest.raises(DataError, match="JointSpace"):
        parameters_of(canonical().fit(waves())).to_estimator(canonical())

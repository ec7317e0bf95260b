"""The corrections of many components: by the library, and by elimination of all at once."""

import pytest
import torch

from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression import corrections as module
from tpgmm_torch.regression.corrections import corrections

M, N, A = 12, 17, 4


def given(n_robots, *, own_times=False, dtype=torch.float32):
    """H, J C, innovations, weights and prior of robots, by their definitions."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = normal(A, N, N)
    prior, jacobian = root @ root.mT / N, normal(n_robots, M, N)
    crossed = jacobian[:, None] @ prior  # (B, A, m, n)
    h = crossed @ jacobian.mT[:, None] + 0.1 * torch.eye(M).double()
    innovation = normal(n_robots, M, A)
    weights = torch.softmax(normal(n_robots, A) if own_times else normal(A), -1)
    mixed = (weights @ prior.flatten(1)).view(-1, N, N)
    rows = (x.transpose(1, 2).reshape(n_robots, M * A, -1) for x in (h, crossed))
    return [x.to(dtype) for x in (*rows, innovation, weights, mixed)]


def reference(h, crossed, innovation, weights, prior):
    """The formulas, with the inverse of H."""
    b = len(h)
    h = h.view(b, M, A, M).transpose(1, 2)
    crossed = crossed.view(b, M, A, N).transpose(1, 2)
    gain = torch.linalg.solve(h, crossed)  # (B, A, m, n)
    moves = (gain.mT @ innovation.mT[..., None])[..., 0]
    explained = gain.mT @ crossed
    return moves, prior - (weights[..., None, None] * explained).sum(1)


@pytest.mark.parametrize("own_times", [False, True], ids=["one time", "own times"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("n_robots", [1, 3, 300])
def test_they_follow_the_formulas(n_robots, dtype, own_times):
    expected = reference(*given(n_robots, own_times=own_times, dtype=torch.float64))
    found = corrections(*given(n_robots, own_times=own_times, dtype=dtype))
    tolerance = {torch.float32: 2e-4, torch.float64: 1e-10}[dtype]
    for own, other in zip(found, expected, strict=True):
        assert own.is_contiguous()  # a library of matrices would loop over any other
        torch.testing.assert_close(own.double(), other, rtol=tolerance, atol=tolerance)


def test_thousands_are_eliminated_where_no_gradient_is_wanted(monkeypatch):
    factorized = []
    plain = module._factorized
    monkeypatch.setattr(module, "_factorized", lambda *x: factorized.append(1) or plain(*x))
    arguments = given(300)
    corrections(*arguments)
    assert not factorized
    arguments[2].requires_grad_()
    moves, _ = corrections(*arguments)
    assert factorized
    moves.sum().backward()
    assert arguments[2].grad.abs().max() > 0
    with torch.no_grad():
        corrections(*given(300))
    assert len(factorized) == 1


@pytest.mark.parametrize("value", [-1.0, 0.0])
@pytest.mark.parametrize("n_robots", [2, 300])
def test_a_direction_without_variance_is_named(n_robots, value):
    h, *others = given(n_robots)
    h.view(n_robots, M, A, M)[1, 5, 2] = h.view(n_robots, M, A, M)[1, :, 2, 5] = 0.0
    h.view(n_robots, M, A, M)[1, 5, 2, 5] = value
    with pytest.raises(DataError, match="covariance of the tasks is not positive definite"):
        corrections(h, *others)

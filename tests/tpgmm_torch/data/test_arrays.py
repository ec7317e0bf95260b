"""Numbers that a user gives, as tensors."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError


@pytest.mark.parametrize(
    "values",
    [[1, 2], (1.0, 2.0), np.array([1, 2]), np.float32([1, 2]), torch.tensor([1, 2])],
    ids=["list", "tuple", "integers", "float32 array", "integer tensor"],
)
def test_what_is_no_floating_tensor_becomes_float64(values):
    tensor = as_tensor(values, "joints")
    assert tensor.dtype == torch.float64
    assert tensor.tolist() == [1.0, 2.0]


def test_floating_tensors_keep_type_and_gradient():
    given = torch.ones(3, dtype=torch.float32, requires_grad=True)
    tensor = as_tensor(given, "joints")
    assert tensor.dtype == torch.float32
    tensor.sum().backward()
    assert torch.equal(given.grad, torch.ones(3))


@pytest.mark.parametrize("kind", ["numpy", "torch", "torch with gradient"])
def test_no_memory_is_shared_with_the_input(kind):
    if kind == "numpy":
        given = np.ones(3)
        tensor = as_tensor(given, "joints")
        given[0] = 7.0
    else:
        given = torch.ones(3, requires_grad=kind != "torch")
        tensor = as_tensor(given, "joints")
        with torch.no_grad():
            given[0] = 7.0
    assert tensor.tolist() == [1.0, 1.0, 1.0]


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6),
    st.integers(0, 5),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_nan_and_infinity_are_refused_with_their_index(values, index, bad):
    values[index] = bad
    where = [index // 3, index % 3]
    with pytest.raises(DataError) as error:
        as_tensor(np.reshape(values, (2, 3)), "joints")
    assert "joints holds 1 value(s) that are NaN or infinite" in str(error.value)
    assert f"the first is {bad} at index {where}" in str(error.value)


@pytest.mark.parametrize("values", [
    [[1.0], [1.0, 2.0]],
    ["one"],
    ["1.0"],
    [1j],
    torch.ones(2, dtype=torch.complex64),
    np.array(["2026-01-01"], dtype="datetime64[s]"),
    [10**400],
    [torch.ones((), requires_grad=True), torch.ones(())],
    {"a": 1.0},
])  # fmt: skip
def test_what_is_no_array_of_numbers_is_refused(values):
    with pytest.raises(DataError, match="joints must be an array of numbers"):
        as_tensor(values, "joints")


def test_a_missing_value_counts_as_nan():
    with pytest.raises(DataError, match=r"NaN or infinite, the first is nan at index \[1\]"):
        as_tensor([1.0, None], "joints")


def test_numbers_are_finite_though_their_sum_is_not():
    for count in (2, 1000):  # added by Python, and by torch
        huge = torch.full((count, 2), 1e308, dtype=torch.float64)
        assert torch.equal(as_tensor(huge.T, "it"), huge.T)
        huge[-1, 1] = math.inf
        with pytest.raises(DataError, match=rf"it holds 1 .* at index \[1, {count - 1}\]"):
            as_tensor(huge.T, "it")

"""Tables of what parameters may be: each kind against values on both sides of its border."""

from fractions import Fraction
from numbers import Integral, Real

import numpy as np
import pytest
import torch
from sklearn.base import BaseEstimator

from tpgmm_torch.constraints import ANYTHING, Interval, Options, check_parameters
from tpgmm_torch.exceptions import InvalidParameterError

INF, NAN = float("inf"), float("nan")
CASES = [
    # a constraint, what fits, what does not
    (Interval(Real, 0, 1, closed="left"), [0, 0.0, Fraction(1, 3)], [1, -1e-300, NAN, INF]),
    (Interval(Real, 0, 1, closed="right"), [1, np.float32(1), 1e-300], [0, 1 + 1e-15]),
    (Interval(Real, 0, 1, closed="both"), [0, 1], [-1, 2]),
    (Interval(Real, 0, 1, closed="neither"), [0.5], [0, 1, True, "0.5", None, 0.5j]),
    (Interval(Real, None, 0, closed="both"), [0, -1e308], [-INF, 1e-9, np.True_]),
    (Interval(Real, 0, None, closed="left"), [0, 1e308], [INF, NAN, False]),
    (Interval(Integral, 1, None, closed="left"), [1, np.int8(3)], [0, 1.0, True, "1"]),
    (Options("time", "random"), ["time", np.str_("random")], ["Time", "", None, b"time"]),
    ("array-like", [[], (1,), np.ones(2), torch.ones(2), {}], ["ab", b"ab", 1, None, list]),
    ("random_state", [None, 0, 2**32 - 1, np.random.RandomState(0)], [-1, 2**32, 1.0, "0"]),
    (None, [None], [0, False, ""]),
    (dict, [{}], [[], dict]),
]


class Estimator(BaseEstimator):
    def __init__(self, value=None, other=None):
        self.value, self.other = value, other


def check(constraints, value, other=None):
    kind = type("Estimator", (Estimator,), {"_parameter_constraints": {"value": constraints}})
    check_parameters(kind(value, other))


@pytest.mark.parametrize(("constraint", "good", "bad"), CASES)
def test_each_kind_ends_where_it_says(constraint, good, bad):
    for value in good:
        check([constraint], value)
    for value in bad:
        with pytest.raises(InvalidParameterError, match="'value' parameter of Estimator"):
            check([constraint], value)


def test_one_of_several_is_enough_and_what_is_not_in_the_table_is_anything():
    for value in (None, "auto", 3):
        check([Options("auto"), Interval(Integral, 1, None, closed="left"), None], value)
    check(ANYTHING, NAN, other=object())

"""How the tests of the mixture cut points into blocks, and fit them."""

import warnings

import numpy as np

from tpgmm_torch.exceptions import ConvergenceWarning

COVARIANCE_TYPES = ("full", "tied", "diag", "spherical")
WIDTHS = (2, 3)


def fitted(model, X, *categories):
    """Fit and return the model; only warnings of the given categories may come."""
    with warnings.catch_warnings():
        for category in categories or (ConvergenceWarning,):
            warnings.simplefilter("ignore", category)
        return model.fit(X)


def split(X, widths=WIDTHS):
    return np.split(X, np.cumsum(widths)[:-1], axis=-1)

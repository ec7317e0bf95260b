"""How likely demonstrations are under a fitted model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.control.reproduction import Reproduction
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.training.local_data import local_data

__all__ = ["Likelihood"]


class Likelihood(Reproduction):
    """What :class:`~tpgmm_torch.TaskParameterizedGMM` says of demonstrations.

    Attributes
    ----------
    mixture_ : BlockGaussianMixture
        Of the local data of all operators.
    """

    mixture_: BlockGaussianMixture

    def score(self, X: Sequence[Demonstration], y: object = None) -> float:
        """Mean log-likelihood per time step of (new) demonstrations.

        It is the likelihood of the local data, so models with other operators are not
        comparable: use :func:`tpgmm_torch.metrics.reproduction_scorer` for those.
        """
        lengths = [len(demonstration) for demonstration in check_demonstrations(X)]
        return float(np.average(self.score_samples(X), weights=lengths))

    def score_samples(self, X: Sequence[Demonstration]) -> NDArray[np.float64]:
        """Mean log-likelihood per time step of each demonstration, shape (n,)."""
        return np.array([self.mixture_.score(row) for row in self._rows(X)])

    def bic(self, X: Sequence[Demonstration]) -> float:
        """Bayesian information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.bic(rows))

    def aic(self, X: Sequence[Demonstration]) -> float:
        """Akaike information criterion on demonstrations; lower is better."""
        rows = np.concatenate(self._rows(X))
        return float(self.mixture_.aic(rows))

    def _rows(self, X: Sequence[Demonstration]) -> list[NDArray[np.float64]]:
        self._check_fitted()
        demonstrations = check_demonstrations(X)
        for operator in self.operators_:
            operator.check(self.kinematics_, demonstrations[0].frames)
        expected = self._regression().expected
        rows = local_data(demonstrations, self.operators_, self.kinematics_, expected)
        return [row.cpu().numpy() for row in rows]

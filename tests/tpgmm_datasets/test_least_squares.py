"""Levenberg-Marquardt: minima from far away, for several starts at once."""

import torch

from tpgmm_datasets.least_squares import levenberg_marquardt


def test_all_starts_find_the_minimum_of_a_curved_valley() -> None:
    def valley(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x, y = points.unbind(-1)
        left = torch.stack((1 - x, 10 * (y - x**2)), -1)
        rows = torch.stack((torch.ones_like(x), 0 * x, 20 * x, -10 + 0 * x), -1)
        return left, rows.reshape(-1, 2, 2)

    starts = torch.tensor([[-1.2, 1.0], [3.0, -4.0], [1.0, 1.0]], dtype=torch.float64)
    points, cost = levenberg_marquardt(valley, starts, 60)
    assert torch.allclose(points, torch.ones_like(points), atol=1e-6)
    assert (cost < 1e-12).all()


def test_a_step_that_does_not_help_is_not_taken() -> None:
    def mislead(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return points, torch.ones(len(points), 1, 1, dtype=torch.float64)  # uphill

    start = torch.full((1, 1), 2.0, dtype=torch.float64)
    points, cost = levenberg_marquardt(mislead, start, 5)
    assert points.item() == 2.0
    assert cost.item() == 2.0

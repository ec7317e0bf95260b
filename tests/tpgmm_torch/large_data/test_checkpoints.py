"""The state of EM on disk: going on equals no pause; what is of another fit is refused."""

import json

import numpy as np
import pytest
import torch

from tests.support.blocks import WIDTHS, fitted
from tests.support.skills import handlings, hands_model
from tpgmm_torch import BlockGaussianMixture
from tpgmm_torch.exceptions import (
    ConvergenceWarning,
    DataError,
    DegenerateComponentWarning,
    ModelFileError,
)
from tpgmm_torch.large_data.checkpoints import Checkpoint

SETTINGS = {"blocks": WIDTHS, "tol": 1e-8, "random_state": 0, "max_iter": 40}


class Interrupted(Exception):
    """What stops a fit in the middle."""


class Failing:
    """A source that fails after so many passes."""

    def __init__(self, rows, passes):
        self.rows, self.left = rows, passes

    def __iter__(self):
        self.left -= 1
        if self.left < 0:
            raise Interrupted
        return iter(np.array_split(self.rows, 3))


def assert_same(model, other, tolerance=1e-9):
    close = {"rtol": tolerance, "atol": tolerance}
    torch.testing.assert_close(model.weights_, other.weights_, **close)
    torch.testing.assert_close(model.means_, other.means_, **close)
    torch.testing.assert_close(model.covariances_, other.covariances_, **close)
    assert model.lower_bounds_ == pytest.approx(other.lower_bounds_, rel=tolerance)
    assert (model.n_iter_, model.converged_) == (other.n_iter_, other.converged_)


def interrupted(model, X, checkpoint, passes):
    with pytest.raises(Interrupted):
        model.fit(Failing(X, passes), checkpoint=checkpoint)
    return checkpoint.n_iter()


@pytest.mark.parametrize("init_params", ["time", "kmeans", "random"])
@pytest.mark.parametrize("n_init", [1, 4])
def test_an_interrupted_fit_goes_on_where_it_was(clusters, tmp_path, init_params, n_init):
    settings = SETTINGS | {"init_params": init_params, "n_init": n_init}
    settings |= {"tol": 0.0, "max_iter": 20}
    checkpoint = Checkpoint(tmp_path / "em", every=3)
    whole = fitted(BlockGaussianMixture(3, **settings), clusters)
    done = interrupted(BlockGaussianMixture(3, **settings), clusters, checkpoint, 16)
    assert 5 < done < 16
    source = Failing(clusters, 100)
    with pytest.warns(ConvergenceWarning):
        resumed = BlockGaussianMixture(3, **settings).fit(source, checkpoint=checkpoint)
    assert_same(resumed, whole)
    assert 100 - source.left < 20  # it did not begin anew


def test_components_placed_anew_are_remembered(clusters, tmp_path):
    means = np.concatenate([clusters[:2], np.full((1, 5), 1e7)])
    settings = {
        "tol": 1e-8, "random_state": 0, "max_iter": 200,
        "weights_init": np.full(3, 1 / 3), "means_init": [means],
        "covariances_init": [np.stack([np.diag(clusters.var(0))] * 3)],
    }  # fmt: skip
    quiet = (DegenerateComponentWarning, ConvergenceWarning)
    whole = fitted(BlockGaussianMixture(3, **settings), clusters, *quiet)
    checkpoint = Checkpoint(tmp_path / "em", every=1)
    assert interrupted(BlockGaussianMixture(3, **settings), clusters, checkpoint, 9) >= 2
    with pytest.warns(DegenerateComponentWarning, match=r"\[2\] in iteration 1"):
        resumed = BlockGaussianMixture(3, **settings).fit(clusters, checkpoint=checkpoint)
    assert_same(resumed, whole)


def test_a_finished_fit_is_taken_as_it_is_and_can_be_prolonged(clusters, tmp_path):
    checkpoint = Checkpoint(tmp_path / "em", every=1000)
    settings = SETTINGS | {"tol": 0.0, "max_iter": 5}
    with pytest.warns(ConvergenceWarning, match="5 iterations"):
        first = BlockGaussianMixture(3, **settings).fit(clusters, checkpoint=checkpoint)
    assert checkpoint.n_iter() == 5
    with pytest.warns(ConvergenceWarning):
        again = BlockGaussianMixture(3, **settings).fit(clusters, checkpoint=checkpoint)
    assert_same(again, first, 0)
    longer = SETTINGS | {"tol": 0.0, "max_iter": 12}
    prolonged = BlockGaussianMixture(3, **longer)
    with pytest.warns(ConvergenceWarning):
        prolonged.fit(clusters, checkpoint=checkpoint)
    assert_same(prolonged, fitted(BlockGaussianMixture(3, **longer), clusters))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_components": 4}, "n_components was 3 and is 4"),
        ({"blocks": (5,)}, r"blocks was \[2, 3\] and is \[5\]"),
        ({"random_state": 1}, "random_state was 0 and is 1"),
        ({"covariance_type": "diag"}, "covariance_type was 'full' and is 'diag'"),
        ({"tol": 1e-3}, "tol was 1e-08 and is 0.001"),
        ({"reg_covar": 1e-3}, "reg_covar was 1e-06 and is 0.001"),
        ({"weights_init": [0.2, 0.3, 0.5]}, "start was .* and is "),
    ],
)
def test_the_state_of_another_fit_is_refused(clusters, tmp_path, settings, message):
    checkpoint = Checkpoint(tmp_path / "em")
    fitted_with = {"n_components": 3} | SETTINGS
    BlockGaussianMixture(**fitted_with).fit(clusters, checkpoint=checkpoint)
    with pytest.raises(ModelFileError, match=f"of another fit: .*{message}.*another folder"):
        BlockGaussianMixture(**fitted_with | settings).fit(clusters, checkpoint=checkpoint)


def test_the_state_of_other_data_is_refused(clusters, tmp_path):
    checkpoint = Checkpoint(tmp_path / "em")
    BlockGaussianMixture(3, **SETTINGS).fit(clusters, checkpoint=checkpoint)
    changed = clusters.copy()
    changed[7, 3] += 1e-3
    other = [changed, clusters[:-1], np.insert(clusters, 5, 1.0, axis=1)]
    for data in other:
        model = BlockGaussianMixture(3, **SETTINGS | {"blocks": (2, data.shape[1] - 2)})
        with pytest.raises(ModelFileError, match="the data are other ones"):
            model.fit(data, checkpoint=checkpoint)


def test_damage_is_noticed_and_nothing_else_is_overwritten(clusters, tmp_path):
    model, path = BlockGaussianMixture(3, **SETTINGS), tmp_path / "em"
    checkpoint = Checkpoint(path)
    model.fit(clusters, checkpoint=checkpoint)
    config = (path / "config.json").read_text()
    (path / "config.json").write_text(config.replace('"n_iter": ', '"n_iter": 1'))
    with pytest.raises(ModelFileError, match="changed after it was saved"):
        model.fit(clusters, checkpoint=checkpoint)
    (path / "config.json").write_text(config)
    tensors = path / "checkpoint.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-9])
    with pytest.raises(ModelFileError, match="truncated"):
        model.fit(clusters, checkpoint=checkpoint)
    other = tmp_path / "letters"
    other.mkdir()
    (other / "letter.txt").write_text("keep me")
    with pytest.raises(ModelFileError, match="not a saved checkpoint"):
        model.fit(clusters, checkpoint=Checkpoint(other))
    assert (other / "letter.txt").read_text() == "keep me"


def test_the_files_hold_names_and_numbers_only(clusters, tmp_path):
    BlockGaussianMixture(3, **SETTINGS).fit(clusters, checkpoint=Checkpoint(tmp_path / "em"))
    names = sorted(item.name for item in (tmp_path / "em").iterdir())
    assert names == ["checkpoint.safetensors", "config.json"]
    assert json.loads((tmp_path / "em" / "config.json").read_text())["format"]
    assert [item.name for item in tmp_path.iterdir()] == ["em"]


@pytest.mark.parametrize("batches", [False, True], ids=["list", "batches"])
def test_demonstrations_go_on_as_well(tmp_path, batches):
    X = [handlings(4)[:2], handlings(4)[2:]] if batches else handlings(4)
    checkpoint = Checkpoint(tmp_path / "em", every=1)
    with pytest.warns(ConvergenceWarning):
        whole = hands_model(tol=0.0, max_iter=6).fit(X)
    with pytest.warns(ConvergenceWarning):
        hands_model(tol=0.0, max_iter=3).fit(X, checkpoint=checkpoint)
    assert checkpoint.n_iter() == 3
    with pytest.warns(ConvergenceWarning):
        resumed = hands_model(tol=0.0, max_iter=6).fit(X, checkpoint=checkpoint)
    torch.testing.assert_close(resumed.means_, whole.means_, rtol=1e-9, atol=1e-9)
    assert resumed.n_iter_ == whole.n_iter_


def test_every_is_a_number_of_iterations(tmp_path):
    with pytest.raises(DataError, match="at least 1, got 0"):
        Checkpoint(tmp_path, every=0)

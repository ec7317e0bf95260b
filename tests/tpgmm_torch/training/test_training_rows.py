"""Demonstrations as rows: in batches as in a list, and a few points for many."""

from collections import Counter
from dataclasses import replace
from itertools import batched

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tests.support.skills import (
    HANDLING,
    HANDS,
    bottle_model,
    canonical,
    few_bottles,
    handlings,
    hands_model,
    same,
    waves,
)
from tpgmm_datasets import EpisodeBatches, save_lerobot
from tpgmm_torch import Demonstration, Frame
from tpgmm_torch.alignment import LinearTimeNormalization
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.mixture.row_file import RowFile
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.training.local_data import Motion, local_data
from tpgmm_torch.training.training_rows import equivalent_points, equivalent_rows


class Batches:
    """Demonstrations in batches, again and again."""

    def __init__(self, demonstrations, size=2):
        self.batches, self.passes = list(map(list, batched(demonstrations, size))), 0

    def __iter__(self):
        self.passes += 1
        return iter(self.batches)


def assert_same(model, other, tolerance=1e-9):
    same(model, other, tolerance)
    assert torch.equal(model.time_, other.time_)
    for one, peak in zip(model.skill.peaks, other.skill.peaks, strict=True):
        assert torch.equal(one, peak) and bool((one > 0).all())
    assert model.lower_bound_ == pytest.approx(other.lower_bound_, rel=tolerance)
    assert (model.n_iter_, model.frame_names_) == (other.n_iter_, other.frame_names_)


def uneven(n=5):
    """Demonstrations on clocks of their own."""
    return [replace(d, time=d.time * (1 + 0.03 * i)) for i, d in enumerate(handlings(n))]


@pytest.mark.parametrize("responsibilities", ["auto", "instant", "point"])
def test_batches_give_the_model_of_the_list(responsibilities):
    model = hands_model(responsibilities=responsibilities, tol=1e-6)
    whole = model.fit(handlings(5))
    parts = hands_model(responsibilities=responsibilities, tol=1e-6).fit(Batches(handlings(5)))
    assert_same(parts, whole)
    [one], [other] = (m.score_samples(handlings(1)) for m in (parts, whole))
    assert one == pytest.approx(other, rel=1e-9)


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_uneven_demonstrations_are_learned_point_by_point_in_batches():
    parts = hands_model().fit(Batches(uneven()))
    assert parts.mixture_.group_size == 1
    assert_same(parts, hands_model().fit(uneven()))


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_signs_of_quaternions_follow_the_first_demonstration_of_all():
    flipped = [
        replace(d, frames={n: Frame(f.position, -f.orientation) for n, f in d.frames.items()})
        for d in uneven()[1:]
    ]
    mixed = [uneven()[0], *flipped]
    assert_same(hands_model().fit(Batches(mixed, 1)), hands_model().fit(mixed))


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_batches_are_read_once_and_may_come_from_a_generator():
    source = Batches(uneven())
    model = hands_model().fit(source)
    assert source.passes <= 2  # one look at what it is, one to read
    assert_same(hands_model().fit(batch for batch in source.batches), model)
    assert_same(hands_model().fit(iter(uneven())), model)


def test_names_order_the_joints_of_all_batches():
    names = waves()[0].joint_names or tuple(f"j{i}" for i in range(waves()[0].n_joints))
    named = [replace(wave, joint_names=names) for wave in waves(4)]
    turned = [*named[:2], *(wave.reorder(names[::-1]) for wave in named[2:])]
    assert_same(canonical().fit(Batches(turned)), canonical().fit(named))


@pytest.mark.parametrize(("spoil", "error", "message"), [
    (lambda d: replace(d, frames={}), DataError, "batch 1 of .*frames"),
    (lambda d: Demonstration(d.time, d.joints[:, :1], d.frames), ShapeError, ".* joints"),
    (lambda d: "a demonstration", DataError, "batch 1 of .*is str"),
])  # fmt: skip
def test_a_batch_unlike_those_before_is_named(spoil, error, message):
    demonstrations = handlings(4)
    demonstrations[3] = spoil(demonstrations[3])
    refused(lambda: hands_model().fit(Batches(demonstrations)), error, message)


def test_uneven_batches_have_no_instants():
    with pytest.raises(DataError, match="one common time grid"):
        hands_model(responsibilities="instant").fit(Batches(uneven()))


def test_a_fit_computes_kinematics_and_local_coordinates_once_per_demonstration(monkeypatch):
    counts = Counter()

    def count_calls(kind, name):
        method = getattr(kind, name)

        def counting(self, *given):
            counts[name] += 1
            return method(self, *given)

        monkeypatch.setattr(kind, name, counting)

    demonstrations = LinearTimeNormalization().fit_transform(few_bottles())
    count_calls(Robot, "state")
    count_calls(Motion, "coordinates")
    model = bottle_model(8, tol=1e-1).fit(demonstrations)
    number = len(demonstrations)
    assert counts["coordinates"] == number * len(model.operators_)
    assert counts["state"] == number + 1  # once more for all start postures together


def test_no_demonstrations_are_refused():
    refused(lambda: hands_model().fit([[], []]), DataError, "no demonstrations")


def test_episodes_of_a_data_set_are_batches(tmp_path):
    shown = [
        Demonstration(np.arange(40) / 50, d.joints[:40], joint_names=("a", "b", "c"))
        for d in waves(5, length=40)
    ]
    path = save_lerobot(shown, tmp_path / "set", fps=50, task="wave")
    batches = EpisodeBatches(path, 2)
    assert [len(batch) for batch in batches] == [2, 2, 1]
    again = [d for batch in batches for d in batch]
    assert len(batches) == 3 and len(again) == 5
    assert_same(canonical().fit(batches), canonical().fit(again))
    refused(lambda: EpisodeBatches(path, 0), ValueError, "size=0")


def test_a_few_points_have_the_moments_of_many():
    rows = local_data(handlings(6), HANDLING, HANDS)
    many = torch.stack(rows)[:, :, :5]  # demonstrations, instants, columns
    mean = many.mean(0)
    scatter = torch.einsum("mti,mtj->tij", many - mean, many - mean) / len(many)
    few = equivalent_points(mean, scatter, 8)
    torch.testing.assert_close(few.mean(1), mean)
    spread = few - mean[:, None]
    torch.testing.assert_close(spread.mT @ spread / 8, scatter, rtol=1e-12, atol=1e-15)


def test_points_without_spread_are_their_mean():
    mean = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    found = equivalent_points(mean, torch.zeros(1, 2, 2, dtype=torch.float64), 3)
    assert torch.equal(found, mean.expand(3, 2)[None])


@pytest.mark.parametrize("in_file", [False, True])
def test_instants_have_the_moments_of_all_demonstrations_block_by_block(in_file):
    """However far the reference."""
    rng, widths, length = np.random.RandomState(0), (2, 3), 20
    many = rng.standard_normal((7, length, 5)) + 1e3
    rows = many.reshape(-1, 5)
    given = RowFile.of([rows]) if in_file else rows
    points, size = equivalent_rows(given, many[0] + 0.5, widths)
    assert size == 4
    points = points.reshape(length, size, 5)
    np.testing.assert_allclose(points.mean(1), many.mean(0), rtol=1e-12)
    for block in (slice(0, 2), slice(2, 5)):
        for t in range(length):
            expected = np.cov(many[:, t, block].T, bias=True)
            found = np.cov(points[t, :, block].T, bias=True)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)

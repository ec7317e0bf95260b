"""Curves beside the scene: the numbers in the page are those of the model."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support import skills
from tpgmm_control.impedance.stiffness import Impedance
from tpgmm_tools.viewing.curves import Mark, as_html, motion_marks, motion_panels
from tpgmm_torch import Hold, Situation, save
from tpgmm_torch.persistence import load_model


@pytest.fixture(scope="module")
def bottle():
    """Learn the paper's skill and make a reproduction."""
    model = skills.small_bottle()
    [trajectory] = model.predict([Situation.of(skills.few_bottles()[1])])
    return model, trajectory


def test_panels_are_the_stiffness_and_the_shares_and_the_page_draws_all_of_each(bottle):
    model, trajectory = bottle
    panels = stiffness, shares = motion_panels(model, trajectory)
    matrix = Impedance(model.kinematics_).joints.matrix(trajectory.covariance)
    [(_, curve)] = stiffness.curves
    np.testing.assert_allclose(curve, matrix.diagonal(dim1=-2, dim2=-1).mean(-1))
    assert stiffness.top == curve.max() > 2 * curve.min()
    for (_, drawn), candidate in zip(shares.curves, trajectory.candidates, strict=True):
        np.testing.assert_allclose(drawn, 100 * candidate.share.mean(-1))
    np.testing.assert_allclose(sum(one for _, one in shares.curves), 100)
    assert shares.curves[1][0] == "joints" and shares.top == 100
    page = as_html(panels)
    drawn = re.findall(r'<polyline [^>]*points="([^"]+)"', page)
    for text, one in zip(drawn, [curve, *(one for _, one in shares.curves)], strict=True):
        points = np.array([point.split(",") for point in text.split()], float)
        np.testing.assert_allclose(points[:, 0], stiffness.time, atol=1e-4)
        np.testing.assert_allclose(points[:, 1], one, rtol=1e-5)
    boxes = re.findall(r'<svg viewBox="0 0 (\S+) (\S+)" preserveAspectRatio', page)
    expected = [(stiffness.time[-1], stiffness.top), (stiffness.time[-1], 100)]
    np.testing.assert_allclose(np.array(boxes, float), expected, rtol=1e-5)


def test_a_panel_says_when_an_object_is_held(bottle):
    model, trajectory = copy.copy(bottle[0]), bottle[1]
    model.holds_ = (Hold("bottle", "l_hand", 5.0, 9.0),)
    held = motion_panels(model, trajectory)[-1]
    [(label, curve)] = held.curves
    assert label == "bottle by l_hand"
    within = (trajectory.time >= 5) & (trajectory.time <= 9)
    np.testing.assert_array_equal(curve, within)
    assert 0 < curve.sum() < len(curve)


def test_tracked_poses_have_shares_but_no_stiffness():
    model = skills.hands()
    [trajectory] = model.predict([skills.new_handling()[0]])
    [panel] = motion_panels(model, trajectory)
    assert [label for label, _ in panel.curves] == ["left from cup", "right from left"]


def test_events_of_the_demonstrations_are_marked_where_they_are(tmp_path):
    times = (0.9, 1.0, 1.1, 1.0)
    shown = [
        replace(one, events={"grasp & lift": at} | ({"slip": 0.5} if at == 0.9 else {}))
        for one, at in zip(skills.waves(), times, strict=True)
    ]
    model = skills.canonical(n_components=4).fit(shown)
    [trajectory] = model.predict([Situation.of(shown[0])])
    [mark] = motion_marks(model, trajectory)  # not all have slipped
    assert (mark.time, mark.label) == (pytest.approx(1.0), "grasp & lift")
    save(model, tmp_path / "model")
    assert motion_marks(load_model(tmp_path / "model"), trajectory) == [mark]
    late = replace(trajectory, time=trajectory.time + 0.5)
    assert motion_marks(model, late)[0].time == pytest.approx(0.5)


def test_marks_are_lines_in_every_panel_and_named_below():
    model = skills.hands()
    [trajectory] = model.predict([skills.new_handling()[0]])
    panels = motion_panels(model, trajectory)
    assert 'class="mark"' not in as_html(panels)
    page = as_html(panels, [Mark(0.25, "grasp & lift")])
    lines = re.findall(r'<line class="mark" x1="(\S+)" x2="(\S+)"', page)
    assert lines == [("0.25", "0.25")] * len(panels)
    assert "&#9478; grasp &amp; lift</span><span>0.2 s<" in page

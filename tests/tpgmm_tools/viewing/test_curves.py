"""Curves beside the scene: the numbers in the page are those of the model."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import skills
from tpgmm_tools.viewing.curves import Mark, as_html, motion_marks, motion_panels
from tpgmm_torch import Hold, Robot, Situation, TaskParameterizedGMM
from tpgmm_torch.impedance.stiffness import Impedance

#: The joints of :func:`skills.waves`, of which the first slides.
SLIDING_ARM = (
    "<robot name='r'><link name='base'/>"
    + "".join(
        f"<link name='{name}'/><joint name='{name}' type='{kind}'><parent link='{parent}'/>"
        f"<child link='{name}'/><axis xyz='0 0 1'/>"
        "<limit lower='-9' upper='9' velocity='9' effort='9'/></joint>"
        for name, parent, kind in (
            ("a", "base", "prismatic"),
            ("b", "a", "revolute"),
            ("c", "b", "revolute"),
        )
    )
    + "</robot>"
)


def polylines(page: str) -> list[np.ndarray]:
    """Times and values of each drawn curve, (T, 2)."""
    drawn = re.findall(r'<polyline [^>]*points="([^"]+)"', page)
    return [np.array([point.split(",") for point in one.split()], float) for one in drawn]


def test_the_page_draws_the_stiffness_that_is_asked_for_and_the_operators_shares(bottle):
    recording, trajectory, _ = bottle
    stiffness, *shares = polylines(recording.page)
    for drawn in (stiffness, *shares):
        np.testing.assert_allclose(drawn[:, 0], trajectory.time - trajectory.time[0], atol=1e-4)
    matrix = Impedance(skills.small_bottle().kinematics_).joints.matrix(trajectory.covariance)
    expected = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)
    np.testing.assert_allclose(stiffness[:, 1], expected, rtol=1e-5)
    assert expected.max() > 2 * expected.min()
    for drawn, candidate in zip(shares, trajectory.candidates, strict=True):
        np.testing.assert_allclose(drawn[:, 1], 100 * candidate.share.mean(-1), rtol=1e-5)
    np.testing.assert_allclose(sum(shares)[:, 1], 100, rtol=1e-4)
    for text in ("[N m/rad]", "position:l_hand@bottle + ", "> canonical<"):
        assert recording.page.count(text) == 1


def test_a_panel_says_when_an_object_is_held(bottle):
    _, trajectory, _ = bottle
    model = copy.copy(skills.small_bottle())
    assert "held" not in [panel.title for panel in motion_panels(model, trajectory)]
    model.holds_ = (Hold("bottle", "l_hand", 5.0, 9.0),)
    held = motion_panels(model, trajectory)[-1]
    [curve] = held.curves
    assert curve.label == "bottle by l_hand"
    within = (trajectory.time >= 5) & (trajectory.time <= 9)
    np.testing.assert_array_equal(curve.values, within)
    assert 0 < curve.values.sum() < len(curve.values)


def test_drawings_show_all_of_each_curve(bottle):
    recording, _, _ = bottle
    lines = polylines(recording.page)
    boxes = re.findall(r'<svg viewBox="0 0 (\S+) (\S+)" preserveAspectRatio', recording.page)
    (end, most), (same, hundred) = [tuple(map(float, box)) for box in boxes]
    assert end == same == lines[0][-1, 0]
    np.testing.assert_allclose((most, hundred), (lines[0][:, 1].max(), 100), rtol=1e-5)


def test_tracked_poses_have_shares_but_no_stiffness():
    model = skills.hands()
    [trajectory] = model.predict([skills.new_handling()[0]])
    [panel] = motion_panels(model, trajectory)
    assert [curve.label.count("left") for curve in panel.curves] == [2, 2]


def test_joints_that_slide_do_not_count_among_newton_metres_per_radian():
    robot = Robot.from_urdf(SLIDING_ARM, links=["c"])
    demonstrations = skills.waves()
    model = skills.canonical(n_components=2, robot=robot).fit(demonstrations)
    [trajectory] = model.predict([Situation.of(demonstrations[0])])
    variances = torch.tensor([1e-8, 0.01, 0.01], dtype=torch.float64)
    trajectory = replace(trajectory, covariance=variances.diag().expand(len(trajectory), 3, 3))
    [stiffness, _] = motion_panels(model, trajectory)
    [expected] = Impedance(robot).joints.matrix(variances[1:2].diag()).flatten()
    np.testing.assert_allclose(stiffness.curves[0].values, expected)


def test_events_of_the_demonstrations_and_parts_are_marked_where_they_are(tmp_path):
    shown = [
        replace(one, events={"grasp & lift": at, **more})
        for one, at, more in zip(
            skills.waves(), (0.9, 1.0, 1.1, 1.0), ({"slip": 0.5}, {}, {}, {}), strict=True
        )
    ]
    model = skills.canonical(n_components=4).fit(shown)
    [trajectory] = model.predict([Situation.of(shown[0])])
    [mark] = motion_marks(model, trajectory)  # not all have slipped
    assert (mark.time, mark.label) == (pytest.approx(1.0), "grasp & lift")
    model.save(tmp_path / "model")
    assert motion_marks(TaskParameterizedGMM.load(tmp_path / "model"), trajectory) == [mark]
    parted = skills.canonical(n_components=4, parts=[1.5]).fit(shown)
    assert motion_marks(parted, trajectory)[1] == Mark(1.5, "part 2")
    named = skills.canonical(n_components=4, parts=["grasp*"]).fit(shown)
    assert [one.label for one in motion_marks(named, trajectory)] == ["part 2: grasp & lift"]
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

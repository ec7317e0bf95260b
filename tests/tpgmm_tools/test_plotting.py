"""Pictures: what their artists hold, not only that they are drawn."""

import numpy as np
import pytest
import torch
from matplotlib.collections import PolyCollection
from matplotlib.patches import Ellipse

from tests.support.local_coordinates import local_coordinates
from tests.support.skills import HANDLING, HANDS, JOINT_NAMES, handlings, hands, waves
from tests.support.worlds import OnPoses
from tpgmm_tools import plotting
from tpgmm_torch import Demonstration, SelectOperators, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_torch.operators.text import format_operator


def joints_model() -> TaskParameterizedGMM:
    return TaskParameterizedGMM(4).fit(waves())


def test_joints_are_drawn_with_bands_and_events_in_the_panels_given():
    [shown, _] = handlings(2)
    axes = plotting.plot_joints(shown, ["left.z", "left.x"], color="k")
    assert [panel.get_ylabel() for panel in axes] == ["left.z", "left.x"]
    at = [shown.joint_names.index(name) for name in ("left.z", "left.x")]
    marks = 1 + len(shown.events)
    for panel, column in zip(axes, at, strict=True):
        assert len(panel.lines) == marks
        np.testing.assert_array_equal(panel.lines[0].get_ydata(), shown.joints[:, column])
    [trajectory] = hands().predict([shown])
    assert plotting.plot_joints(trajectory, ["left.z", "left.x"], axes) == axes
    [band] = axes[0].collections
    high = trajectory.joints[:, at[0]] + 2 * trajectory.covariance[:, at[0], at[0]].sqrt()
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(float(high.max()))
    with pytest.raises(UnknownNameError, match="knee"):
        plotting.plot_joints(shown, ["knee"])


def test_components_are_contours_of_one_standard_deviation():
    model, [axes] = joints_model(), plotting.figure(1, "").axes
    plotting.plot_components(axes, model, operator=0, column=1)
    ellipses = [p for p in axes.patches if isinstance(p, Ellipse)]
    assert len(ellipses) == 4
    plane = [0, 2]
    for ellipse, mean, covariance in zip(
        ellipses, model.means_[0].numpy(), model.covariances_[0].numpy(), strict=True
    ):
        np.testing.assert_allclose(ellipse.center, mean[plane])
        # points of the contour are one standard deviation away, all around
        angles = np.linspace(0, 2 * np.pi, 7)
        circle = np.stack((np.cos(angles), np.sin(angles)), axis=1) / 2
        turn = np.radians(ellipse.angle)
        rotate = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        rim = circle * [ellipse.width, ellipse.height] @ rotate.T
        square = np.einsum("ni,ij,nj->n", rim, np.linalg.inv(covariance[plane][:, plane]), rim)
        np.testing.assert_allclose(square, 1, rtol=1e-6)


def test_local_coordinates_are_those_of_the_operator():
    demonstrations, [axes] = handlings(2), plotting.figure(1, "").axes
    [trajectory] = hands().predict(demonstrations[:1])
    reproduction = trajectory, demonstrations[0].frames, {"linestyle": "--"}
    plotting.plot_local(axes, hands(), 0, 2, demonstrations, [reproduction])
    motion = Demonstration(trajectory.time, trajectory.joints, demonstrations[0].frames)
    assert len(axes.lines) == 3
    for line, source in zip(axes.lines, [*demonstrations, motion], strict=True):
        np.testing.assert_array_equal(line.get_xdata(), source.time)
        wanted = local_coordinates(HANDLING[0], source, HANDS)[:, 2]
        np.testing.assert_array_equal(np.abs(line.get_ydata()), wanted.abs())
    assert axes.lines[2].get_linestyle() == "--"
    assert axes.lines[2].get_color() != axes.lines[0].get_color()
    assert len([p for p in axes.patches if isinstance(p, Ellipse)]) == 6


def test_quaternions_are_drawn_on_the_side_of_the_components():
    [demonstration], [axes] = handlings(1), plotting.figure(1, "").axes
    flipped = Demonstration(
        demonstration.time, OnPoses().flipped_answer(demonstration.joints), demonstration.frames
    )
    plotting.plot_local(axes, hands(), 0, 3, [demonstration, flipped])
    one, other = (line.get_ydata() for line in axes.lines)
    np.testing.assert_allclose(one, other)
    means = hands().means_[0][:, 4].numpy()
    assert np.sign(one.mean()) == np.sign(means.mean())


def test_candidates_are_drawn_with_their_spread():
    model, [axes] = joints_model(), plotting.figure(1, "").axes
    [trajectory] = model.predict([Situation([0.0, 1.0, 0.0])])
    plotting.plot_candidates(axes, trajectory, "b", ["canonical"])
    candidate, column = trajectory.candidates[0], JOINT_NAMES.index("b")
    own, result = axes.lines
    np.testing.assert_array_equal(own.get_ydata(), candidate.mean[:, column])
    np.testing.assert_array_equal(result.get_ydata(), trajectory.joints[:, column])
    assert [line.get_label() for line in axes.lines] == ["canonical", "TP-GMM"]
    [band] = [c for c in axes.collections if isinstance(c, PolyCollection)]
    spread = candidate.covariance[:, column, column].sqrt()
    height = torch.from_numpy(band.get_paths()[0].vertices[:, 1])
    assert float(height.max()) == pytest.approx(float((candidate.mean[:, 1] + spread).max()))
    assert float(height.min()) == pytest.approx(float((candidate.mean[:, 1] - spread).min()))
    assert axes.get_ylabel() == "b [rad]"


@pytest.mark.parametrize(
    ("suffix", "magic"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")]
)
def test_a_figure_is_written_in_vectors_with_fonts_that_publishers_take(
    suffix, magic, tmp_path
):
    drawing = plotting.figure(1, "a title")
    plotting.shade(drawing.axes[0], {"reach": (0.0, 1.0)})
    written = plotting.save(drawing, tmp_path / f"figure.{suffix}").read_bytes()
    assert written.startswith(magic)
    assert b"<image" not in written and b"/Subtype /Image" not in written
    assert b"/Subtype /Type3" not in written


def test_candidates_that_matter_stand_above_the_others():
    selection = SelectOperators(robot=HANDS).fit(handlings())
    [axes] = plotting.figure(1, "").axes
    plotting.plot_relevance(axes, selection)
    labels = [label.get_text() for label in axes.get_yticklabels()]
    names = [format_operator(one) for one in selection.candidates_]
    kept = {names[j] for j in np.flatnonzero(selection.support_)}
    assert set(labels[: len(kept)]) == kept and len(labels) == len(selection.candidates_)
    [image] = axes.images
    column = names.index(labels[0])
    wanted = selection.relevance_[:, column].clip(min=0)
    np.testing.assert_allclose(image.get_array()[0], wanted)
    assert [line.get_ydata()[0] for line in axes.lines] == [len(kept) - 0.5]

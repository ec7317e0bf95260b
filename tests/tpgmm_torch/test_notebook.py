"""What objects show of themselves in a notebook."""

from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
import torch

from tests.support.skills import HANDLING, HANDS, handlings, hands_model
from tpgmm_torch import Canonical, Demonstration, Frame, RelativePosition, Robot, Situation
from tpgmm_torch.exceptions import UnknownNameError
from tpgmm_torch.notebook import Tabular
from tpgmm_torch.robots.joint_space import JointSpace

matplotlib.use("agg")


@pytest.fixture(scope="module")
def shown():
    return handlings(4)


@pytest.fixture(scope="module")
def model(shown):
    return hands_model(plausibility="ignore").fit(shown)


@pytest.fixture(autouse=True)
def closed():
    """No figure is left open."""
    yield
    from matplotlib import pyplot

    pyplot.close("all")


class Cells(HTMLParser):
    """The texts of a table; what is opened is closed."""

    def __init__(self, text):
        super().__init__()
        self.texts, self.open = [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.texts.append(text)


def texts(thing):
    return Cells(thing._repr_html_()).texts


def test_each_shows_what_it_is(shown, model):
    situation = Situation.of(shown[0])
    [trajectory] = model.predict([situation])
    told = {
        "Demonstration": (shown[0], "cup"),
        "Situation": (situation, "cup"),
        "Trajectory": (trajectory, "left.x"),
        "Candidate": (trajectory.candidates[0], "shape"),
        "Poses": (HANDS, "left, right"),
        "Stack": (HANDLING[0], "RelativePosition"),
        "Canonical": (Canonical(), "tolerance"),
        "JointSpace": (JointSpace(("a", "b")), "a [-inf, inf], b [-inf, inf]"),
    }
    for name, (thing, part) in told.items():
        assert isinstance(thing, Tabular)
        found = texts(thing)
        assert found[0] == name and any(part in text for text in found), found
    assert "TaskParameterizedGMM" in model._repr_html_()  # scikit-learn's


def test_names_are_escaped():
    frames = {"<b>cup</b>": Frame([0.1, 0, 0])}
    joints = ["<script>", "a&b"]
    one = Demonstration([0.0, 1.0], np.zeros((2, 2)), frames, joints, {"<i>": 0.5})
    for thing in (one, Situation.of(one), RelativePosition("<u>", "<b>cup</b>")):
        text = thing._repr_html_()
        assert not any(tag in text for tag in ("<script", "<b>", "<i>", "<u>"))
        assert any("<b>cup</b>" in each for each in texts(thing))


def test_texts_are_short(shown, model):
    situation = Situation.of(shown[0])
    [trajectory] = model.predict([situation])
    controller = model.controller(shown[0].joints[0], shown[0].frames)
    command = controller.step(0.1)
    state = HANDS.state(shown[0].joints)
    things = (
        shown[0], situation, trajectory, trajectory.candidates[0], command, command.estimate,
        state, model.summary_,
    )  # fmt: skip
    for thing in things:
        assert repr(thing).startswith(type(thing).__name__) and len(repr(thing)) < 200
    assert "running" in repr(command)


def test_demonstrations_and_trajectories_are_drawn_into_the_same_panels(shown, model):
    one = Demonstration(
        shown[0].time, shown[0].joints, shown[0].frames, shown[0].joint_names, {"close": 1.0}
    )
    [trajectory] = model.predict([one])
    axes = one.plot(["left.z", "left.x"], color="k")
    assert [panel.get_ylabel() for panel in axes] == ["left.z", "left.x"]
    for panel, name in zip(axes, ("left.z", "left.x"), strict=True):
        drawn, mark = panel.lines
        column = one.joint_names.index(name)
        np.testing.assert_allclose(drawn.get_ydata(), one.joints[:, column])
        assert list(mark.get_xdata()) == [1.0, 1.0]
    assert [text.get_text() for text in axes[0].texts] == ["close"]
    assert trajectory.plot(["left.z", "left.x"], axes) == axes
    [band] = axes[0].collections
    column = trajectory.joint_names.index("left.z")
    deviation = trajectory.covariance[:, column, column].sqrt()
    highest = (trajectory.joints[:, column] + 2 * deviation).max()
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(float(highest))
    assert len(one.plot()) == one.n_joints
    bare = Demonstration([0.0, 1.0], torch.zeros(2, 2))
    assert [panel.get_ylabel() for panel in bare.plot()] == ["joint_0", "joint_1"]
    with pytest.raises(UnknownNameError, match=r"'elbow'.*left"):
        one.plot(["elbow"])


def test_robots_tell_their_limits():
    urdf = """<robot name="r"><link name="base"/><link name="tip"/>
    <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="2" velocity="1" effort="1"/></joint></robot>"""
    assert "turn [-1, 2]" in texts(Robot.from_urdf(urdf, ["tip"]))

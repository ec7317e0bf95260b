"""What a person showed is brought to where it belongs in the skill."""

import pytest
import torch
from sklearn.base import clone

from tests.support.skills import handlings, hands, wave, waves
from tpgmm_torch import Demonstration, Situation, TaskParameterizedGMM
from tpgmm_torch.corrections import in_skill_time
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.exceptions import DataError, NotFittedError

NAMES = ("a", "b", "c")


@pytest.mark.parametrize(("begin", "end"), [(0.0, 2.0), (0.5, 1.5), (1.2, 2.0)])
@pytest.mark.parametrize("pace", [0.5, 1.0, 2.0])
def test_a_segment_is_found(begin, end, pace):
    model = TaskParameterizedGMM(n_components=8).fit(waves())
    skill = torch.linspace(begin, end, 101, dtype=torch.float64)
    bump = 0.3 * torch.sin(torch.pi * (skill - begin) / (end - begin)).unsqueeze(-1)
    shown = Demonstration(
        7 + (skill - begin) * pace, wave(skill) + bump, joint_names=NAMES, events={"mid": 7.1}
    )
    [placed] = in_skill_time(model, [shown])
    assert abs(float(placed.time[0]) - begin) < 0.1
    assert abs(float(placed.time[-1]) - end) < 0.1
    assert torch.equal(placed.joints, shown.joints)
    assert placed.time[0] <= placed.events["mid"] <= placed.time[-1]


def test_frames_say_where():
    shown = handlings()[2]
    part = slice(8, 22)
    time = shown.time[part] - shown.time[part][0]
    name, link = next(iter(shown.frames)), hands().robot.links[0]
    held = [Hold(name, link, float(time[5]))]
    segment = Demonstration(
        time, shown.joints[part], shown.frames, shown.joint_names, holds=held
    )
    [placed] = in_skill_time(hands(), [segment])
    [hold] = placed.holds
    assert hold.begin == pytest.approx(float(placed.time[5]), abs=1e-12)
    assert hold.end == float("inf")
    assert abs(float(placed.time[0] - shown.time[8])) < 0.08
    assert abs(float(placed.time[-1] - shown.time[21])) < 0.08


def test_a_correction_is_learned_where_it_was_made():
    demonstrations = waves(10, 60)
    model = TaskParameterizedGMM(n_components=8).fit(demonstrations)
    time = torch.linspace(0.6, 1.4, 25, dtype=torch.float64)  # at the rate of the others
    bump = 0.5 * torch.sin(torch.pi * (time - 0.6) / 0.8).unsqueeze(-1)
    segment = Demonstration(time - 0.6, wave(time) + bump, joint_names=NAMES)
    start = Situation(joints=waves(1)[0].joints[0])
    [before] = model.predict([start])
    # warnings are errors: a segment in the skill's time is on the clock of the others
    refitted = clone(model).fit([*demonstrations, *in_skill_time(model, [segment])])
    [after] = refitted.predict([start])
    moved = (after.joints - before.joints).abs().amax(-1)
    middle = (model.time_ - 1.0).abs().argmin()
    assert 0.5 / 11 * 0.5 < float(moved[middle]) < 0.5 / 11 * 1.5
    assert float(moved[:10].max()) < 0.03  # EM of the refit ends elsewhere, by a little


def test_what_cannot_be_placed_is_refused():
    model = TaskParameterizedGMM(n_components=4).fit(waves())
    long = Demonstration([0.0, 50.0], wave(torch.tensor([0.0, 2.0])), joint_names=NAMES)
    with pytest.raises(DataError, match="50 s"):
        in_skill_time(model, [long])
    with pytest.raises(DataError, match="one time step"):
        in_skill_time(model, [Demonstration([0.0], [[0.0] * 3], joint_names=NAMES)])
    with pytest.raises(NotFittedError):
        in_skill_time(TaskParameterizedGMM(), [long])

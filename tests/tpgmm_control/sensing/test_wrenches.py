"""Measured wrenches: filter, contact with hysteresis, age; efforts in place of a sensor."""

import mujoco
import numpy as np
import pytest
import torch

from tpgmm_control.sensing.wrenches import Wrenches, WrenchReading, wrench_of_efforts
from tpgmm_torch.exceptions import ShapeError, UnknownNameError
from tpgmm_torch.robots.robot import Robot


def forces(values):
    wrench = np.zeros((*np.shape(values), 6))
    wrench[..., 2] = values
    return wrench


def test_contact_begins_at_the_threshold_and_ends_at_half_of_it_after_a_dwell():
    reading = WrenchReading.first(1.5, (2,))
    seen = []
    for step in range(300):
        force = 2.0 if 50 <= step < 100 else 1.0 if step < 200 else 0.2
        # the second robot is hit once, for a tick
        other = 4.0 if step == 150 else 0.0
        reading = reading.update(forces([force * (step >= 50), other]), 0.005)
        seen.append(reading.contact.copy())
    first, second = np.array(seen).T
    begin, end = np.flatnonzero(np.diff(first.astype(int)))
    assert 0.014 <= (begin - 49) * 0.005 <= 0.04
    assert 0.014 <= (end - 199) * 0.005 <= 0.05
    assert not second.any()


def test_what_is_not_finite_changes_nothing_but_the_age():
    reading = WrenchReading.first(1.5, (2,)).update(forces([8.0, 8.0]), 0.01)
    gap = forces([8.0, 8.0])
    gap[1, 4] = np.nan
    for _ in range(30):
        reading = reading.update(gap, 0.01)
    np.testing.assert_allclose(reading.age, [0.0, 0.3])
    assert np.isfinite(reading.value).all()
    wrenches = Wrenches(("hand",), (2,), {}, {"hand": reading})
    [(text, late)] = wrenches.late(0.2).items()
    assert "hand" in text
    np.testing.assert_array_equal(late, [0.0, np.inf])
    assert wrenches.late(0.4) == {}


def test_other_links_and_shapes_are_refused():
    wrenches = Wrenches(("hand",), (2,))
    with pytest.raises(UnknownNameError, match="hand"):
        wrenches.update(0.01, {"foot": np.zeros(6)})
    for shape in ((3, 6), (2, 3), (6, 2)):
        with pytest.raises(ShapeError, match=r"\(2, 6\)"):
            wrenches.update(0.01, {"hand": np.zeros(shape)})
    assert wrenches.update(0.01, {"hand": np.zeros(6)}).readings["hand"].value.shape == (2, 6)


MASS = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
ARM = f"""<mujoco><option gravity="0 0 0"/><worldbody>
<body>{MASS}<joint axis="0 0 1" name="a"/>
<body pos=".3 0 0">{MASS}<joint axis="0 1 0" name="b"/>
<body pos=".3 0 0">{MASS}<joint axis="0 1 0" name="c"/><body name="tip" pos=".2 0 0">{MASS}
</body></body></body></body></worldbody></mujoco>"""


def test_efforts_of_drives_give_the_force_that_mujoco_applies():
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = joints = [0.3, -0.4, 0.9]
    mujoco.mj_forward(model, data)
    efforts, force = np.zeros(3), np.array([2.0, -1.0, -8.0])
    tip = model.body("tip").id
    mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xpos[tip], tip, efforts)
    robot = Robot.from_mjcf(ARM, ["tip"])
    state = robot.state(joints)
    found = wrench_of_efforts(state, "tip", torch.from_numpy(efforts))
    # three drives tell three numbers: what they do not feel is not in it
    again = state.jacobian("tip").mT @ found
    np.testing.assert_allclose(again, efforts, atol=1e-12)

"""The generated skill: carrying a bottle to a tray with both hands."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.bottle.carry_and_put import (
    PHASES,
    CarryAndPut,
    before_sliding,
    slid,
    slide,
)
from tpgmm_torch import Frame, quaternions

RATE = 25
ENDS = dict(zip(PHASES, np.cumsum(list(PHASES.values())), strict=True))


@pytest.fixture(scope="module")
def skill():
    return CarryAndPut(rate=RATE)


@pytest.fixture(scope="module")
def demonstrations(skill):
    return skill.demonstrations(6, seed=3)


def test_the_bottle_ends_on_the_tray_however_it_slid(skill, demonstrations):
    slides = np.array([slid(d) for d in demonstrations])
    assert np.abs(slides[:, 0]).max() <= 0.03 and np.ptp(slides[:, 0]) > 0.02
    assert np.degrees(np.abs(slides[:, 1]).max()) <= 10
    for d in demonstrations:
        distance, angle = skill.put_error(d.frame("bottle")[-1], d.frame("tray"))
        assert distance < 1e-9 and angle < 1e-6
        assert d.frame("bottle").batch_shape == d.time.shape


def test_the_hands_hold_the_bottle_as_it_slid(skill, demonstrations):
    for d in demonstrations:
        bottle = d.frame("bottle")
        arrived = int(torch.searchsorted(d.time, d.events["grasp"])) - RATE // 5
        put = int(torch.searchsorted(d.time, d.events["put"]))
        distance, angle = skill.grasp_error(d.joints[arrived], bottle[0])
        assert distance < 1e-4 and angle < 1e-3
        held = before_sliding(bottle[arrived + RATE // 5 : put + 1], slid(d))
        distance, angle = skill.grasp_error(d.joints[arrived + RATE // 5 : put + 1], held)
        # one step of inverse kinematics each 40 ms, and a shoulder that may touch its limit
        assert distance.max() < 2e-3 and angle.max() < 1e-2
        off, _ = skill.grasp_error(d.joints[put], bottle[put])
        assert off == pytest.approx(abs(slid(d)[0]), abs=0.02)  # turned by up to 10 degrees


def test_the_nominal_path_has_the_nominal_times_and_the_given_slide(skill):
    [situation], slides = skill.situations(1, seed=5), np.array([[-0.03, 0.17]])
    [path] = skill.nominal([situation], slides)
    assert path.duration == pytest.approx(ENDS["rest"], abs=1 / RATE)
    assert path.events == pytest.approx(
        {"grasp": ENDS["hold"], "put": ENDS["lower"], "rest": ENDS["leave"]}
    )
    np.testing.assert_allclose(slid(path), slides[0], atol=1e-9)


def test_sliding_is_undone():
    rng = np.random.default_rng(0)
    slides = rng.uniform(-1, 1, (4, 2)) * (0.03, 0.2)
    turns = quaternions.normalize(torch.from_numpy(rng.standard_normal((4, 4))))
    stood = Frame(rng.standard_normal((4, 3)), turns)
    again = before_sliding(stood.compose(slide(slides)), slides)
    torch.testing.assert_close(again.position, stood.position)
    torch.testing.assert_close(again.orientation, stood.orientation)

"""Signs and offsets of motors: found from postures, or refused where these do not tell."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tpgmm_datasets import DatasetError, Scale, estimate_motor_map
from tpgmm_datasets.robots import so101_urdf
from tpgmm_torch import Frame, Robot, quaternions

LINK = "gripper_frame_link"
ARM = Robot.from_urdf(so101_urdf(), [LINK])
MOTORS = [f"{name}.pos" for name in ARM.joint_names]
ACCURACY = {"position_std": 0.001, "orientation_std": math.radians(0.5)}


def record(
    seed: int, n: int = 10, noise: float = 1.0, reach: float = 0.8
) -> tuple[Tensor, Frame, Tensor, Tensor]:
    """Degrees of motors, poses, and the signs and offsets [rad] that are to be found."""
    generator = torch.Generator().manual_seed(seed)
    options: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    middle, half = (ARM.lower + ARM.upper) / 2, (ARM.upper - ARM.lower) / 2
    joints = middle + reach * half * (2 * torch.rand(n, 6, **options) - 1)
    signs = torch.randn(6, **options).sign()
    offsets = math.pi * (2 * torch.rand(6, **options) - 1)
    degrees = torch.rad2deg(signs * (joints - offsets))
    state = ARM.state(joints)
    turn = quaternions.exp(noise * math.radians(0.5) * torch.randn(n, 3, **options))
    poses = Frame(
        state.position(LINK) + noise * 0.001 * torch.randn(n, 3, **options),
        quaternions.product(turn, state.orientation(LINK)),
    )
    return degrees + noise * 0.1 * torch.randn(n, 6, **options), poses, signs, offsets


def errors(found: Any, offsets: Tensor, names: list[str]) -> Tensor:
    estimated = torch.tensor([found.offsets[name] for name in names], dtype=torch.float64)
    difference = estimated - offsets[: len(names)]
    return torch.rad2deg(torch.remainder(difference + math.pi, math.tau) - math.pi)


@pytest.mark.parametrize("seed", range(3))
def test_signs_are_right_and_offsets_as_good_as_they_say(seed: int) -> None:
    # ten recordings of which the gripper was tracked at five instants each
    degrees, poses, signs, offsets = record(seed, n=50)
    found = estimate_motor_map(ARM, LINK, degrees, poses, names=MOTORS, units="deg", **ACCURACY)
    arm = MOTORS[:5]
    assert list(found.signs) == arm
    assert list(found.signs.values()) == signs[:5].int().tolist()
    assert errors(found, offsets, arm).abs().max() < 0.5
    spread = torch.tensor([math.degrees(found.uncertainty[name]) for name in arm])
    assert (spread < 0.2).all()
    assert (errors(found, offsets, arm).abs() < 5 * spread).all()
    assert 0.001 < found.position_error < 0.003
    assert math.radians(0.5) < found.orientation_error < math.radians(1.2)


def test_scales_with_a_zero_of_their_own_and_known_motors_are_kept() -> None:
    degrees, poses, signs, offsets = record(3, noise=0.0)
    scale = Scale(math.pi / 180, 0.4)
    right = Scale(signs[4].item() * math.pi / 180, offsets[4].item())
    units = dict.fromkeys(MOTORS, scale) | {"wrist_roll.pos": right}
    found = estimate_motor_map(
        ARM, LINK, degrees, poses, names=MOTORS, units=units, known=["wrist_roll.pos"]
    )
    assert "wrist_roll.pos" not in found.signs
    assert found.units["wrist_roll.pos"] == right
    for i, name in enumerate(MOTORS[:4]):
        unit = found.units[name]
        assert unit.factor == pytest.approx(signs[i].item() * math.pi / 180)
        assert math.remainder(unit.offset - offsets[i].item(), math.tau) == pytest.approx(0)


def test_positions_alone_tell_all_but_the_roll() -> None:
    degrees, poses, signs, offsets = record(1)
    given = {"names": MOTORS, "units": "deg", "orientations": False, "position_std": 0.002}
    message = r"motor 'wrist_roll.pos' .*known=\['wrist_roll.pos'\]"
    with pytest.raises(DatasetError, match=message):
        estimate_motor_map(ARM, LINK, degrees[:6], poses[:6], **given)
    roll = Scale(signs[4].item() * math.pi / 180, offsets[4].item())
    units = {**dict.fromkeys(MOTORS, "deg"), "wrist_roll.pos": roll}
    given |= {"units": units, "known": ["wrist_roll.pos"]}
    found = estimate_motor_map(ARM, LINK, degrees, poses, **given)
    assert errors(found, offsets, MOTORS[:4]).abs().max() < 1.5
    assert math.isnan(found.orientation_error)
    assert "shoulder_pan.pos" in str(found)
    assert str(found).endswith("mm (root mean square)")


def test_a_motor_that_stood_still_is_pointed_out() -> None:
    generator = torch.Generator().manual_seed(0)
    joints = 0.5 * torch.randn(10, 6, generator=generator, dtype=torch.float64)
    joints[:, 2] = 0.3
    state = ARM.state(joints)
    still = Frame(state.position(LINK), state.orientation(LINK))
    message = r"sign and the offset of motor 'elbow_flex'.*more post"
    with pytest.raises(DatasetError, match=message):
        estimate_motor_map(ARM, LINK, torch.rad2deg(joints), still, units="deg")


def test_poses_that_are_not_the_robots_are_refused() -> None:
    degrees, poses, _, _ = record(4)
    elsewhere = Frame(poses.position + torch.tensor([0.3, 0, 0]), poses.orientation)
    with pytest.raises(DatasetError, match=r"times further from the robot .* base frame"):
        estimate_motor_map(ARM, LINK, degrees, elsewhere, names=MOTORS, units="deg", **ACCURACY)


def test_what_does_not_fit_together_is_refused() -> None:
    degrees, poses, _, _ = record(5)
    given: tuple[Any, ...] = (
        ((degrees[:, :5], poses), {}, r"shape \(n, 6\).*got values \(10, 5\)"),
        ((degrees, poses[:9]), {}, r"poses \(9,\)"),
        ((degrees, poses), {"known": ["thumb"]}, r"known motors \['thumb'\] are not among"),
        ((degrees, poses), {"known": ARM.joint_names}, "0 motors move the link"),
    )
    for values, options, message in given:
        with pytest.raises(DatasetError, match=message):
            estimate_motor_map(ARM, LINK, *values, units="deg", **options)

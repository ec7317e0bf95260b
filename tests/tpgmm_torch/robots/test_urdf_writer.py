"""What is written as a URDF is read as it was."""

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.support.robot_zoo import ZOO
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch.robots.urdf import free_name, placement, read_urdf, roll_pitch_yaw, write_urdf

angles = st.floats(-4, 4) | st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])


@pytest.mark.parametrize("text", [ZOO, upper_body_urdf()])
def test_it_is_the_inverse_of_the_reader(text: str) -> None:
    model = read_urdf(text)
    again = read_urdf(write_urdf(model.name, model.root, model.joints))
    assert (again.name, again.root) == (model.name, model.root)
    assert set(again.links) == set(model.links)
    for one, other in zip(again.joints, model.joints, strict=True):
        for field in fields(one):
            found, expected = getattr(one, field.name), getattr(other, field.name)
            if field.name in ("origin", "axis"):
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
            else:
                assert found == expected


@given(angles, angles, angles, st.sampled_from([0.0, 1e-3, 1e-8, 1e-12]))
def test_angles_make_the_rotation_again(x: float, y: float, z: float, off: float) -> None:
    rotation = Rotation.from_euler("ZYX", [z, y + off, x]).as_matrix()
    again = placement(np.zeros(3), roll_pitch_yaw(rotation))
    np.testing.assert_allclose(again[:3, :3], rotation, rtol=0, atol=1e-15)


def test_names_that_are_taken_get_another_end() -> None:
    assert free_name("arm", ["hand"]) == "arm"
    assert free_name("arm", ["arm", "arm_"]) == "arm__"

import numpy as np
import pytest

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.targets import FAMILIES, Board, bundle, cube, modules_of, tag, target_from

POSE = [0, 0, 0.1, 1, 0, 0, 0]


def outward(corners):
    """The direction in which the tag looks, x to the right and y up."""
    x, y = corners[1] - corners[0], corners[0] - corners[3]
    return np.cross(x, y) / np.linalg.norm(x) ** 2


def test_the_faces_of_a_cube_look_outwards_from_its_middle():
    made = cube([4, 5, 6, 7, 8, 9], 0.04)
    for corners in made.corners.values():
        middle = corners.mean(0)
        assert np.linalg.norm(middle) == pytest.approx(0.025)
        np.testing.assert_allclose(outward(corners), middle / 0.025, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), 0.04)
    assert len(cube([1, 2], 0.04, 0.06).corners) == 2


def test_a_bundle_is_made_of_its_tags():
    pose = [0.1, 0.2, 0.3, 1, 0, 0, 0]
    made = bundle({3: pose}, 0.05)
    np.testing.assert_allclose(made.corners[3], tag(3, 0.05).corners[3] + pose[:3])


def test_entries_of_a_cell_are_what_the_functions_make():
    for entry, made in (
        ({"tag": 3, "size": 0.06}, tag(3, 0.06)),
        ({"cube": [1, 2], "size": 0.04, "side": 0.06}, cube([1, 2], 0.04, 0.06)),
        ({"bundle": {"3": POSE}, "size": 0.05}, bundle({3: POSE}, 0.05)),
        ({"tag": 3, "size": 0.06, "family": "aruco_4x4"}, tag(3, 0.06, "aruco_4x4")),
    ):  # fmt: skip
        found = target_from(entry)
        assert found.family == made.family and found.corners.keys() == made.corners.keys()
        for number, corners in made.corners.items():
            np.testing.assert_array_equal(found.corners[number], corners)


@pytest.mark.parametrize(
    "wrong",
    [
        {}, {"tag": 3}, {"tag": 3, "cube": [1], "size": 0.1}, {"tag": 3, "size": 60},
        {"tag": 3, "size": -0.1}, {"tag": 10**6, "size": 0.1}, {"tag": "x", "size": 0.1},
        {"cube": [1, 1], "size": 0.1}, {"cube": [1], "size": 0.1, "side": 0.05},
        {"bundle": {"1": [0, 0]}, "size": 0.1}, {"tag": 1, "size": 0.1, "family": "qr"},
        {"tag": 1, "size": 0.1, "side": 0.1}, {"cube": 4, "size": 0.1}, {"tag": 1, "size": "a"},
        {"tag": 1, "size": 0.1, "colour": 1}, {"bundle": [1], "size": 0.1},
    ],
)  # fmt: skip
def test_what_is_no_target_is_refused_and_named(wrong):
    with pytest.raises(DataError, match="the cup"):
        target_from(wrong, "the cup")


def test_tags_have_as_many_modules_as_their_family_and_boards_are_boards():
    assert {name: modules_of(name) for name in ("apriltag_36h11", "aruco_4x4")} == {
        "apriltag_36h11": 8, "aruco_4x4": 6,
    }  # fmt: skip
    assert Board().drawn.getChessboardSize() == (8, 5) and "aruco_5x5" in FAMILIES
    for wrong in ({"columns": 2}, {"marker": 0.04}, {"family": "qr"}):
        with pytest.raises(DataError):
            Board(**wrong)

"""Printed targets: seen as they are named, in true size, and cubes fold to their target."""

import json
from collections import Counter
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.pdf_pages import Page, pdf_pages
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.detection.tags import TagDetector
from tpgmm_vision.printing import PAGES, print_targets
from tpgmm_vision.targets import FAMILIES, Board, cube, target_from

DPI = 100


def seen(page: Page, family: str = "apriltag_36h11") -> dict[int, np.ndarray]:
    """Corners of the tags on a page, by detection [mm, y up]."""
    found = TagDetector(family)(page.picture(DPI))
    assert not found.twice
    return {
        number: (corners + 0.5) / DPI * 25.4 * (1, -1) + (0, page.height)
        for number, corners in found.corners.items()
    }


def check_square(corners: np.ndarray, size: float) -> None:
    """Upright, in true size to 0.1 mm."""
    square = size / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    assert np.abs(corners - corners.mean(0) - square).max() < 0.05


@pytest.mark.parametrize("page", PAGES)
def test_single_tags_are_seen_in_true_size_on_as_many_pages_as_they_need(page, tmp_path):
    numbers = list(range(3, 10))
    entries = print_targets(tmp_path / "tags.pdf", numbers, size=0.06, page=page)
    assert [target_from(one).corners.keys() for one in entries] == [{n} for n in numbers]
    pages = pdf_pages(tmp_path / "tags.pdf")
    assert all(np.allclose((one.width, one.height), PAGES[page], atol=0.01) for one in pages)
    found = [seen(one) for one in pages]
    assert len(found) > 1
    assert [number for one in found for number in sorted(one)] == numbers
    for one in found:
        for corners in one.values():
            check_square(corners, 60)


@pytest.mark.parametrize("family", FAMILIES)
def test_tags_of_every_family_are_seen_in_true_size(family, tmp_path):
    entries = print_targets(tmp_path / "tag.pdf", [7], size=0.03, family=family)
    assert target_from(entries[0]).family == family
    [page] = pdf_pages(tmp_path / "tag.pdf")
    found = seen(page, family)
    assert list(found) == [7]
    check_square(found[7], 30)


def test_a_tag_is_one_area_and_words_keep_clear_of_it(tmp_path):
    print_targets(tmp_path / "tags.pdf", [0, 1], size=0.04)
    [page] = pdf_pages(tmp_path / "tags.pdf")
    assert len(page.areas) == 2  # seams would show between areas
    for area, number in zip(page.areas, "01", strict=True):
        low, high = area.min((0, 1)), area.max((0, 1))
        x, y, _ = next(one for one in page.words if one[2] == f"{number}   40 mm")
        assert low[0] - 5 < x < high[0]
        # capitals are 0.4 x 0.73 of a module high, and two modules of white would be 10 mm
        assert low[1] - 5 < y < low[1] - 0.6 * 5 - 0.3 * 5


def test_each_page_has_a_ruler_of_100_mm_and_what_to_do(tmp_path):
    print_targets(tmp_path / "all.pdf", [0], [[10, 11, 12, 13, 14]], Board(), size=0.04)
    pages = pdf_pages(tmp_path / "all.pdf")
    assert len(pages) == 3
    for page in pages:
        ruler = [points for points, _ in page.lines if abs(np.ptp(points[:, 0]) - 100) < 0.01]
        assert any(np.ptp(points[:, 1]) == 0 for points in ruler)
        words = " ".join(text for *_, text in page.words)
        assert "measure the ruler" in words.lower()
        assert "L / 100" in words
        everything = np.concatenate([points for points, _ in page.lines])
        assert everything.min() > 6.9
        assert (everything < (page.width - 6.9, page.height - 6.9)).all()


def edge_of(one: np.ndarray, other: np.ndarray) -> frozenset[tuple[float, float]]:
    """An edge by its two ends, each rounded to 0.1."""
    return frozenset(tuple(np.round(point, 1) + 0) for point in (one, other))


def edges(cell: np.ndarray) -> set[frozenset[tuple[float, float]]]:
    """Edges of a square whose side is 1, by its lower left corner."""
    ring = cell + np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    return {edge_of(*ends) for ends in pairwise(ring)}


@pytest.mark.parametrize("size", [0.02, 0.041])
def test_a_net_folds_to_its_cube(size, tmp_path):
    numbers = [10, 31, 12, 13, 44, 15]
    [entry] = print_targets(tmp_path / "cube.pdf", cubes=[numbers], size=size)
    assert entry == {"cube": numbers, "size": size}
    [page] = pdf_pages(tmp_path / "cube.pdf")
    found, side = seen(page), size * 1e3 * 10 / 8
    assert set(found) == set(numbers)
    for corners in found.values():
        check_square(corners, size * 1e3)
    squares = {n: found[n].mean(0) - side / 2 for n in numbers}
    # names of faces stand on them
    names = {}
    for x, y, text in page.words:
        for number, corner in squares.items():
            if (np.array([x, y]) > corner).all() and (np.array([x, y]) < corner + side).all():
                assert text.startswith(f"{number} ")
                names[number] = text.split()[1]
    assert list(names[n] for n in numbers) == ["+x", "-x", "+y", "-y", "+z", "-z"]
    # faces that share a folding line, in units of their side from the face +x
    cells = {n: (corner - squares[10]) / side for n, corner in squares.items()}
    lines = [((points - squares[10]) / side, dashed) for points, dashed in page.lines]
    shared = Counter(edge for cell in cells.values() for edge in edges(cell))
    dashed = {edge_of(*points) for points, is_dashed in lines if is_dashed}
    hinges = {edge for edge, count in shared.items() if count == 2}
    assert len(hinges) == 5
    assert hinges < dashed
    # fold away from who looks at the print, beginning with the face +x
    first = np.eye(4)
    first[:3, :3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    middle = np.append(squares[10] + side / 2, 0)
    first[:3, 3] = np.array([side / 2, 0, 0]) - first[:3, :3] @ middle
    folded, left = {10: first}, [10]
    while left:
        one = left.pop()
        for other in squares.keys() - folded.keys():
            if common := hinges & edges(cells[one]) & edges(cells[other]):
                [hinge] = common
                point = np.append(squares[10] + side * np.array(sorted(hinge)[0]), 0)
                out = np.append(cells[other] - cells[one], 0)
                turn = Rotation.from_rotvec(np.cross(out, [0, 0, -1]) * np.pi / 2).as_matrix()
                fold = np.eye(4)
                fold[:3, :3], fold[:3, 3] = turn, point - turn @ point
                folded[other] = folded[one] @ fold
                left.append(other)
    flat = {n: np.c_[c, np.zeros(4), np.ones(4)] for n, c in found.items()}
    for number, corners in cube(numbers, size).corners.items():
        there = (flat[number] @ folded[number].T)[:, :3]
        np.testing.assert_allclose(there, corners * 1e3, atol=0.15)
    # each of the other edges of the cube has one flap
    flaps, joints = [points for points, _ in lines if len(points) == 4], set()
    for points in flaps:
        edge = edge_of(points[0], points[-1])
        assert edge in dashed
        [owner] = [n for n, cell in cells.items() if edge in edges(cell)]
        middle = squares[10] + side * points[[0, -1]].mean(0)
        place = (folded[owner] @ np.append(middle, [0, 1]))[:3] / side
        joints.add(tuple(np.round(place, 1) + 0))
    assert len(joints) == len(flaps) == 7
    # and no flap lies over a face or another
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    covered = np.zeros((500, 600), dtype=int)
    for outline in [*flaps, *(cell + square for cell in cells.values())]:
        middle = outline.mean(0)
        inner = 100 * (middle + 0.98 * (outline - middle)) + 200
        blank = np.zeros(covered.shape, dtype=np.uint8)
        covered += cv2.fillPoly(blank, [np.rint(inner).astype(int)], 1)
    assert covered.max() == 1


def test_five_numbers_leave_the_face_below_free(tmp_path):
    print_targets(tmp_path / "cube.pdf", cubes=[[10, 11, 12, 13, 14]], size=0.03)
    [page] = pdf_pages(tmp_path / "cube.pdf")
    assert set(seen(page)) == {10, 11, 12, 13, 14}
    assert [text for *_, text in page.words if text == "-z"]
    assert any(json.dumps({"cube": [10, 11, 12, 13, 14], "size": 0.03}) in text
               for *_, text in page.words)  # fmt: skip


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("board", [Board(), Board(5, 7, 0.02, 0.015, "apriltag_36h11")])
def test_a_board_is_seen_whole_and_in_true_size(page, board, tmp_path):
    assert print_targets(tmp_path / "board.pdf", board=board, page=page) == []
    [sheet] = pdf_pages(tmp_path / "board.pdf")
    detector = cv2.aruco.CharucoDetector(board.drawn)
    corners, numbers, markers, _ = detector.detectBoard(sheet.picture(DPI))
    assert len(numbers) == (board.columns - 1) * (board.rows - 1)
    assert len(markers) == board.columns * board.rows // 2
    found = corners.reshape(-1, 2) / DPI * 25.4
    expected = board.drawn.getChessboardCorners()[numbers.ravel(), :2] * 1e3
    off = (found - found.mean(0)) - (expected - expected.mean(0))
    assert np.abs(off).max() < 0.05
    edge = seen(sheet, board.family)
    assert len(edge) == len(markers)
    check_square(edge[3], board.marker * 1e3)


@pytest.mark.parametrize(
    "given, message",
    [
        ({}, "nothing|tags, cubes and a board"),
        ({"tags": [1], "page": "a0"}, "a4.*letter.*'a0'"),
        ({"tags": [1, 2, 1]}, r"\[1\] are asked for twice"),
        ({"tags": [3], "cubes": [[3, 4]]}, r"\[3\] are asked for twice"),
        ({"tags": [587]}, "0 to 586"),
        ({"tags": [1], "family": "apriltag"}, "'apriltag' are not known; there are"),
        ({"cubes": [[1, 2, 3, 4, 5, 6, 7]]}, "one to six"),
        ({"tags": [1], "size": 60}, "60000 mm does not fit on a page 'a4', 156 mm.*in mm in"),
        ({"tags": [1], "size": 6e-5}, "at least 4 mm, got 0.06 mm.*in mm in the command"),
        ({"tags": [1], "size": float("nan")}, "got nan"),
        ({"tags": [1], "size": float("inf")}, "got inf"),
        ({"cubes": [[1, 2]], "size": 0.05}, "a cube .* 50 mm does not fit .* 41 mm would"),
        ({"board": Board(8, 5, 0.04, 0.03)}, "40 mm does not fit on a page 'a4', 34 mm would"),
    ],
)
def test_what_cannot_be_printed_is_an_error_that_says_what_can(given, message, tmp_path):
    with pytest.raises(DataError, match=message):
        print_targets(tmp_path / "x.pdf", **given)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "given",
    [
        {"tags": [1], "size": 0.156},
        {"cubes": [[1]], "size": 0.041},
        {"board": Board(8, 5, 0.034, 0.024)},
    ],
)
def test_what_an_error_says_would_fit_does(given, tmp_path):
    print_targets(tmp_path / "x.pdf", **given)


def test_users_settings_of_matplotlib_change_nothing(tmp_path):
    import matplotlib

    print_targets(tmp_path / "usual.pdf", [1])
    mine = {"savefig.bbox": "tight", "font.size": 30, "lines.linewidth": 9}
    with matplotlib.rc_context(mine):
        print_targets(tmp_path / "set.pdf", [1])
    [usual], [other] = pdf_pages(tmp_path / "usual.pdf"), pdf_pages(tmp_path / "set.pdf")
    assert (usual.width, usual.height) == (other.width, other.height)
    np.testing.assert_array_equal(usual.picture(50), other.picture(50))

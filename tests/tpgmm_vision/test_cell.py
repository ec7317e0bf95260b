import copy
import json

import numpy as np
import pytest

from tpgmm_torch.exceptions import DataError
from tpgmm_vision import cell as module
from tpgmm_vision.cell import cell_from, read_cell, write_cell

#: The example of the documentation.
CONTENT = json.loads(module.__doc__.split("code-block:: json")[1])


def changed(path, value):
    content = copy.deepcopy(CONTENT)
    at = content
    for name in path[:-1]:
        at = at.setdefault(name, {})
    if value is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return content


def test_a_cell_is_written_and_read_and_stays_readable(tmp_path):
    path = tmp_path / "cell.json"
    written, found = write_cell(CONTENT, path), read_cell(path)
    assert found.content == written.content == CONTENT
    assert found.cameras["front"].camera.width == 640 and found.objects["cup"].upright
    np.testing.assert_allclose(found.checks["base"].pose[:3, 3], (0.1, 0.2, 0.0))
    assert max(map(len, path.read_text().splitlines())) < 100
    assert '"focal_length": [554.0, 554.0],' in path.read_text()


CUP, FRONT = ("objects", "cup"), ("cameras", "front")
OTHER = {"target": {"tag": 11, "size": 0.04}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "the cell is an object"),
        ({"camera": {}}, "the cell has no entries .'camera'."),
        (changed(("cameras",), []), "cameras is an object of named entries"),
        (changed((*FRONT, "size"), [640]), "cameras: front: size is 2 finite numbers"),
        (changed((*FRONT, "size"), ...), "cameras: front needs 'size'"),
        (changed((*FRONT, "focal_length"), [0, 0]), "cameras: front: a camera has"),
        (changed((*FRONT, "focal_length"), [True, 1]), "front: focal_length is 2 finite"),
        (changed((*FRONT, "key"), 3), "front: key is a text"),
        (changed((*FRONT, "pose"), [0, 0, 0, 2, 0, 0, 0]), "front: pose: a quaternion"),
        (changed((*FRONT, "colour"), "red"), "front has no entries .'colour'."),
        (changed(("cameras", "side"), CONTENT["cameras"]["front"]), "cameras share a key"),
        (changed((*CUP, "target"), 3), "objects: cup: target is an object such as"),
        (changed((*CUP, "target", "size"), 40), "objects: cup: target: the size of a tag"),
        (changed((*CUP, "upright"), "yes"), "cup: upright is true or false"),
        (changed((*CUP, "height"), float("nan")), "cup: height is a finite number"),
        (changed(("objects", "pot"), OTHER), "tag 11 belongs to 'cup' and to 'pot'"),
        (changed(("checks", "base", "pose"), ...), "checks: base needs 'pose'"),
        (changed(("joint_offsets", "elbow"), 0.1), "joint_offsets of .'elbow'."),
        (changed(("joint_offsets", "shoulder_lift"), "1"), "shoulder_lift is a finite"),
        (changed(("joints",), "all"), "joints is a list of texts"),
        (changed(("source",), 3), "source is a text"),
    ],
)
def test_what_is_wrong_is_named(content, message, tmp_path):
    with pytest.raises(DataError, match=message):
        cell_from(content)
    with pytest.raises(DataError):
        write_cell(content, tmp_path / "cell.json")
    assert not list(tmp_path.iterdir())


def test_cameras_without_poses_can_be_listed_but_not_used(tmp_path):
    cell = cell_from(changed((*FRONT, "pose"), ...))
    with pytest.raises(DataError, match=r"cameras \['front'\] of the cell have no pose"):
        cell.require_placed_cameras()
    with pytest.raises(DataError, match="no cameras"):
        cell_from({}).require_placed_cameras()
    (tmp_path / "cell.json").write_text("{")
    with pytest.raises(DataError, match="is no JSON file"):
        read_cell(tmp_path / "cell.json")

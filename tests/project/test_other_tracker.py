"""The example of a tracker in another process: found by its entry point, honest about ages."""

import inspect
import json
import re
import socket
import subprocess
import sys
import textwrap
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import Cell, cell_from
from tpgmm_vision.sources import ObservedPose, pose_source

FOLDER = Path(__file__).parents[2] / "examples" / "other_tracker"
CELL = {
    "source": "udp",
    "objects": {"cup": {}, "lid": {"pose": [0, 0, 0.1, 1, 0, 0, 0]}},
}
CUP = {"object": "cup", "pose": [0.4, 0.1, 0.02, 0, 1, 0, 0], "std": [0.002, 0.02]}


@pytest.fixture
def port(monkeypatch, tmp_path) -> int:
    """A free port, with the example installed."""
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text("utf-8"))["project"]
    [(group, entries)] = project["entry-points"].items()
    installed = tmp_path / "udp_poses-0.1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: udp_poses\nVersion: 0.1.0\n"
    )
    lines = [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (installed / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(FOLDER)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    monkeypatch.setenv("TPGMM_POSES_PORT", str(number))
    return number


@pytest.fixture
def source(port):
    made = pose_source(cell_from(CELL))
    yield made
    made.close()


def send(port: int, *messages: object) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for message in messages:
            text = message if isinstance(message, bytes) else json.dumps(message).encode()
            sender.sendto(text, ("127.0.0.1", port))


def until(asked: Callable[[], bool]) -> None:
    """Wait for a datagram to have its effect."""
    end = time.monotonic() + 10
    while not asked():
        assert time.monotonic() < end
        time.sleep(0.005)


def poses(source) -> dict[str, ObservedPose]:
    return source.poses({}, {}, 0.0)


def test_poses_come_from_the_process_that_the_example_shows_and_grow_old_without_it(
    source, port
):
    [shown] = re.findall(r"code-block:: python\n\n((?:    .*\n|\n)+)",
                         inspect.getdoc(sys.modules["udp_poses"]))  # fmt: skip
    script = textwrap.dedent(shown)
    assert "47123" in script
    tracker = subprocess.Popen([sys.executable, "-c", script.replace("47123", str(port))])
    try:
        until(lambda: poses(source)["cup"].valid)
        cup = poses(source)["cup"]
        np.testing.assert_allclose(cup.pose, [0.4, 0.1, 0.02, 1, 0, 0, 0])
        np.testing.assert_allclose(cup.covariance, np.diag([0.002**2] * 3 + [0.02**2] * 3))
    finally:
        tracker.kill()
        tracker.wait()
    until(lambda: not poses(source)["cup"].valid)
    late = poses(source)["cup"]
    np.testing.assert_allclose(late.pose, cup.pose)
    assert re.fullmatch(r"the last pose was received 0\.\d\d s ago", late.reason)


def test_an_object_is_where_the_cell_says_in_what_is_tracked(source, port):
    send(port, CUP, CUP | {"object": "lid"}, CUP | {"object": "mug"})
    until(lambda: poses(source)["lid"].valid)
    # turned upside down about x
    np.testing.assert_allclose(poses(source)["lid"].pose, [0.4, 0.1, -0.08, 0, 1, 0, 0])
    assert poses(source).keys() == {"cup", "lid"}


def test_what_never_came_is_nowhere_and_says_so(source, port):
    send(port, CUP)
    until(lambda: poses(source)["cup"].valid)
    lid = poses(source)["lid"]
    assert not lid.valid
    assert np.isnan(lid.pose).all()
    assert lid.reason == "no pose of 'lid' was received, but of ['cup']"
    source.reset()
    assert np.isnan(poses(source)["cup"].pose).all()


@pytest.mark.parametrize("message", [
    b"rubbish",
    b"\xff\xfe",
    {"object": "cup"},
    [1, 2],
    CUP | {"pose": [0.4, 0.1, 0.02, 1, 1, 0, 0]},
    CUP | {"pose": [0.4, 0.1, None, 1, 0, 0, 0]},
    CUP | {"std": [0.002]},
    CUP | {"std": [0.002, -1]},
    CUP | {"object": ["cup"]},
], ids=str)  # fmt: skip
def test_what_is_no_pose_stops_the_robot_and_is_shown(message, source, port):
    assert source.problem == ""
    send(port, message)
    until(lambda: source.problem != "")
    assert source.problem.startswith("the tracker sent ")
    source.reset()
    send(port, CUP)  # and the source still lives
    until(lambda: poses(source)["cup"].valid)
    assert source.problem == ""


def test_a_problem_that_the_tracker_tells_is_handed_on(source, port):
    send(port, {"problem": "the camera was moved"})
    until(lambda: source.problem == "the camera was moved")


def test_a_port_that_is_taken_is_an_error_that_says_what_to_do(source):
    with pytest.raises(DataError, match=r"port \d+ cannot be listened to.*TPGMM_POSES_PORT"):
        pose_source(Cell(source="udp"))


def test_only_another_source_finds_what_has_no_tags():
    with pytest.raises(DataError, match="objects: cup needs 'target'"):
        cell_from(CELL | {"source": "tags"})

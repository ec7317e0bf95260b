"""Tracking a recorded data set: what is in the copy, who reads it, and what is refused."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from tests.support.command_line import run
from tests.support.lerobot_sets import change_info
from tests.support.recorded_tags import KEY, NUMBER, carried, cell_content, record
from tpgmm_datasets import describe_lerobot, load_lerobot
from tpgmm_datasets.errors import DatasetError
from tpgmm_datasets.events import find_events, parse_event
from tpgmm_datasets.signals import Signals
from tpgmm_torch import find_holds
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.tracked_poses import Poses
from tpgmm_vision.episodes.tracking import track_lerobot
from tpgmm_vision.poses import pose_vector, rigid

pytestmark = pytest.mark.slow

ROBOT = Poses(["hand"])
#: Rows of the episodes, in which of them the tag is covered, and how far all is moved.
EPISODES = ((60, (), 0.0), (65, ((30, 36),), 0.02), (60, ((15, 47),), -0.02))
#: How far the recorded hand is from where it was [m].
OFFSET = 0.02
FEATURE = "observation.environment_state"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root, episodes = tmp_path_factory.mktemp("set") / "set", []
    for drawn, hands, _ in (carried(*one) for one in EPISODES):
        wrong = rigid([0, 0, 0], [-OFFSET, 0, 0])
        episodes.append((drawn, [wrong @ hand for hand in hands]))
    return record(root, episodes, codec="h264")


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    path = tmp_path_factory.mktemp("cell") / "cell.json"
    path.write_text(json.dumps(cell_content(joint_offsets={"hand.x": OFFSET})))
    return path


@pytest.fixture(scope="module")
def tracked(original, cell, tmp_path_factory):
    steps = []
    out = tmp_path_factory.mktemp("out") / "tracked"
    reports = track_lerobot(original, out, cell, ROBOT, progress=lambda *now: steps.append(now))
    rows = sum(rows for rows, *_ in EPISODES)
    assert steps == [(row + 1, rows) for row in range(rows)]
    return out, reports


def written(path, **changed):
    path.write_text(json.dumps(cell_content(**changed)))
    return path


def test_poses_are_those_of_the_object(tracked):
    shown = load_lerobot(tracked[0])
    for one, (rows, covered, shift) in zip(shown, EPISODES, strict=True):
        true, cup = pose_vector(carried(rows, covered, shift)[2]), one.frames["cup"]
        assert np.linalg.norm(cup.position.numpy() - true[:, :3], axis=1).max() < 2e-3
        turned = np.abs((cup.orientation.numpy() * true[:, 3:]).sum(axis=1))
        assert np.degrees(2 * np.arccos(turned.min())) < 5  # flat, seen from the front


def test_columns_say_what_was_seen_and_what_was_inferred(tracked):
    out, reports = tracked
    description = describe_lerobot(out)
    assert not description.problems
    assert description.frames == ("cup",)
    keys = {column.key for column in description.columns}
    assert {"tracking.seen", "tracking.known", "tracking.residual"} <= keys
    for report, (rows, covered, _) in zip(reports, EPISODES, strict=True):
        hidden = [row for a, b in covered for row in range(a, b + 1)]
        track = report.tracks["cup"]
        assert np.flatnonzero(~track.seen).tolist() == hidden
        assert track.known.all()
        assert len(track.seen) == rows


def test_lerobot_opens_the_copy(tracked, original):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.feature_utils import dataset_to_policy_features

    opened = LeRobotDataset("test/tags", root=tracked[0], video_backend="pyav")
    row = opened[40]
    assert row[FEATURE].shape == (7,)
    assert row["tracking.seen"].shape == (1,) or row["tracking.seen"].shape == ()
    assert row[KEY].shape == (3, 240, 320)
    inputs = dataset_to_policy_features(opened.meta.features)
    assert not [key for key in inputs if key.startswith("tracking")]
    assert opened.meta.stats["tracking.seen"]["mean"] < 1
    video = f"videos/{KEY}/chunk-000/file-000.mp4"
    assert (tracked[0] / video).samefile(original / video)  # linked


def test_offsets_of_joints_are_declared_and_read_by_all(tracked, original):
    before, after = load_lerobot(original), load_lerobot(tracked[0])
    for one, other in zip(before, after, strict=True):
        away = (other.joints - one.joints).numpy()
        assert np.allclose(away, [OFFSET, 0, 0, 0, 0, 0, 0], atol=1e-6)
    commanded = load_lerobot(tracked[0], joints="action", units="raw")
    assert np.allclose(commanded[0].joints, after[0].joints)
    signals = Signals.of(tracked[0], ROBOT)
    assert signals.units == {} and signals.cell  # which has the offsets


def test_offsets_that_are_no_numbers_are_refused(tracked, tmp_path):
    root = shutil.copytree(tracked[0], tmp_path / "set")

    def wrong(info):
        info["features"]["observation.state"]["info"]["offsets"] = [0.0, float("nan")]

    change_info(root, wrong)
    with pytest.raises(DatasetError, match="joint offsets are 7 numbers"):
        load_lerobot(root)


def test_the_cell_and_a_report_with_pictures_are_beside(tracked, cell):
    out, _ = tracked
    assert (out / "meta/cell.json").read_text() == cell.read_text()
    page = (out / "report.html").read_text()
    assert page.count("<img src=") >= 4
    assert "cup is not seen: no tag of it is seen" in page


def test_events_and_holds_are_found_in_tracks(tracked):
    shown = load_lerobot(tracked[0], robot=ROBOT)
    lifted = find_events(shown, {"lift": parse_event("moving:cup")})
    assert np.allclose([one.events["lift"] for one in lifted], 0.8, atol=0.16)
    [hold] = find_holds(shown, ROBOT)
    assert (hold.frame, hold.link) == ("cup", "hand")
    assert 0.5 < hold.begin < 0.9
    assert 1.6 < hold.end < 2.1


@pytest.mark.filterwarnings("always::tpgmm_torch.exceptions.PlausibilityWarning")
def test_without_a_robot_what_is_covered_on_the_way_stays_unknown(original, cell, tmp_path):
    reports = track_lerobot(original, tmp_path / "out", cell)
    known = [one.tracks["cup"].known.all() for one in reports]
    assert known == [True, False, False]
    done = run("dataset", "track", original, tmp_path / "again", "--cell", cell)
    assert done.exit_code == 0
    said = " ".join(done.stderr.split())
    assert "in episodes 1,2, and their last poses are repeated. With --robot" in said


def test_episodes_that_cannot_be_tracked_are_named_and_nothing_is_written(cell, tmp_path):
    late = [(0, 30)]
    never = [(0, 100)]
    shown = [carried(60, covered)[:2] for covered in ((), late, never, never)]
    root = record(tmp_path / "set", shown, codec="h264")
    with pytest.raises(DatasetError, match="cannot be followed in episodes") as caught:
        track_lerobot(root, tmp_path / "out", cell, ROBOT)
    said = str(caught.value)
    assert "episodes [1, 2, 3]" in said
    assert "object 'cup': it was first seen 1.24 s after the start" in said
    assert re.search("episode 2: object 'cup': it was never seen: no tag of it is seen", said)
    assert "(and 1 more like it: episode 3)" in said
    assert "lerobot-edit-dataset" in said
    assert {item.name for item in tmp_path.iterdir()} == {"set"}


def test_a_camera_that_was_moved_is_noticed(tmp_path):
    shown, hands, _ = carried(40)
    base = rigid([0, 0, 0], [0.12, -0.08, 0.0])
    knocked = rigid([0, 0, 0], [0.14, -0.08, 0.0])
    episodes = [([{**tags, 7: place} for tags in shown], hands) for place in (base, knocked)]
    root = record(tmp_path / "set", episodes, codec="h264")
    pose = pose_vector(base).tolist()
    checks = {"base": {"target": {"tag": 7, "size": 0.06}, "pose": pose}}
    cell = written(tmp_path / "cell.json", checks=checks)
    with pytest.raises(DatasetError, match=r"episodes \[1\].*camera 'front' was moved"):
        track_lerobot(root, tmp_path / "out", cell, ROBOT)


def test_tags_that_are_there_twice_are_said(tmp_path, monkeypatch):
    shown, hands, _ = carried(40)
    other = rigid([0, 0, 0], [0.12, -0.08, 0.0])
    # tag 9 is drawn with the pattern of the object's
    plain = cv2.aruco.generateImageMarker

    def draw(family, number, *rest):
        return plain(family, NUMBER if number == 9 else number, *rest)

    monkeypatch.setattr(cv2.aruco, "generateImageMarker", draw)
    episodes = [([{**tags, 9: other} for tags in shown], hands)]
    root = record(tmp_path / "set", episodes, codec="h264")
    with pytest.raises(DatasetError, match=r"never seen: tag 3 is seen twice"):
        track_lerobot(root, tmp_path / "out", written(tmp_path / "cell.json"), ROBOT)


def test_what_cannot_be_is_refused_at_once(tracked, original, cell, tmp_path):
    with pytest.raises(DatasetError, match="was tracked: track the set that"):
        track_lerobot(tracked[0], tmp_path / "out", cell, ROBOT)
    with pytest.raises(DatasetError, match="exists; remove it"):
        track_lerobot(original, tracked[0], cell, ROBOT)
    large, top = cell_content(), cell_content()
    large["cameras"]["front"]["size"] = [640, 480]
    top["cameras"]["front"]["key"] = "observation.images.top"
    for content, error, message in (
        (large, DataError, "calibrated for 640 x 480 pixels, got 320 x 240"),
        (top, DatasetError, r"no pictures \['observation\.images\.top'\]"),
        ({"joint_offsets": {"elbow": 0.1}}, DatasetError, "'elbow' is not among the values"),
        ({"joints": ["shoulder_pan"]}, DataError, "another robot"),
    ):
        wrong = written(tmp_path / "wrong.json", **content)
        with pytest.raises(error, match=message):
            track_lerobot(original, tmp_path / "out", wrong, ROBOT)
    assert not (tmp_path / "out").exists()

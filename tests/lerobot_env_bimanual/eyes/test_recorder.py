"""Sets that are recorded with cameras, as LeRobot and this project read them."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_env_bimanual.eyes.recorder import recording, row
from tpgmm_datasets import load_lerobot
from tpgmm_torch.exceptions import DataError
from tpgmm_vision.cell import read_cell

SIZE = (96, 64)
TASK = "bend the elbow"


def opened_at(path, **options):
    cell = {"joints": ["elbow"]}
    return recording(path, 10, ["elbow", "wrist"], {"front": SIZE}, cell, **options)


def rows(n, grey, **more):
    for k in range(n):
        picture = np.full((*SIZE[::-1], 3), grey + 5 * k, np.uint8)
        state, action = (0.1 * k, -0.1 * k), (0.1 * (k + 1), -0.1)
        yield row(TASK, state, action, {"front": picture}, **more)


@pytest.mark.parametrize("codec", ["av1", "h264", "pictures"])
def test_lerobot_reads_what_was_recorded(tmp_path, codec):
    with opened_at(tmp_path / "set", codec=codec, objects=["cup"], robot_type="arm") as opened:
        for grey, n in ((40, 6), (120, 8)):
            for one in rows(n, grey, poses=(0.1, 0.2, 0.3, 1, 0, 0, 0)):
                opened.add_frame(one)
            opened.save_episode()
    read = LeRobotDataset("local/set", root=tmp_path / "set", video_backend="pyav")
    assert (read.num_episodes, len(read), read.fps) == (2, 14, 10)
    for index, grey in ((0, 40), (5, 65), (6, 120), (13, 155)):
        seen = 255 * read[index]["observation.images.front"].mean()
        assert float(seen) == pytest.approx(grey, abs=3)
    assert read[7]["task"] == TASK
    [first, second] = load_lerobot(tmp_path / "set")
    assert first.joint_names == ("elbow", "wrist") and len(second.time) == 8
    np.testing.assert_allclose(first.joints[:, 0], 0.1 * np.arange(6), atol=1e-6)
    assert list(first.frames) == ["cup"]
    assert read_cell(tmp_path / "set" / "cell.json").joints == ("elbow",)


def test_what_is_discarded_is_not_in_the_set(tmp_path):
    with opened_at(tmp_path / "set") as opened:
        for grey, keep in ((40, True), (90, False), (120, True)):
            for one in rows(5, grey):
                opened.add_frame(one)
            opened.save_episode() if keep else opened.clear_episode_buffer()
        for one in rows(3, 0):  # and what nobody saved
            opened.add_frame(one)
    read = LeRobotDataset("local/set", root=tmp_path / "set", video_backend="pyav")
    assert (read.num_episodes, len(read)) == (2, 10)
    seen = 255 * read[5]["observation.images.front"].mean()
    assert float(seen) == pytest.approx(120, abs=3)


def test_an_error_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="robot fell"), opened_at(tmp_path / "set") as opened:
        for one in rows(4, 0):
            opened.add_frame(one)
        opened.save_episode()
        for one in rows(2, 0):
            opened.add_frame(one)
        raise RuntimeError("robot fell")
    with pytest.raises(DataError, match="no episode"), opened_at(tmp_path / "set"):
        pass
    assert not (tmp_path / "set").exists()
    assert [item.name for item in tmp_path.iterdir() if item.is_dir()] == []


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "set").mkdir()
    with pytest.raises(DataError, match="exists"), opened_at(tmp_path / "set"):
        pass
    assert list((tmp_path / "set").iterdir()) == []


def test_unknown_codecs_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"av1.*'gif'"):
        opened_at(tmp_path / "set", codec="gif").__enter__()

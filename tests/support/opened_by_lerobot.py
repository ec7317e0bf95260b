"""Run by the test of the writer in a process of its own: LeRobot warns on import."""

import os
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from written_sets import FPS, assert_same, demonstration  # this folder is on the path

from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_datasets.writer import add_frames
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame

NUMBERS = ("episode_index", "index", "frame_index")


def opened(root):
    return LeRobotDataset("local/set", root=root)


def pose(frame):
    return torch.cat((frame.position, frame.orientation), dim=-1)


def check_every_frame(root, demonstrations):
    dataset = opened(root)
    assert dataset.fps == FPS
    assert dataset.num_episodes == len(demonstrations)
    assert len(dataset) == sum(map(len, demonstrations))
    row = 0
    for episode, item in enumerate(demonstrations):
        joints = item.joints.float()
        for step in range(len(item)):
            frame = dataset[row]
            poses = torch.cat((pose(item.frames["bottle"]), pose(item.frames["hand"])[step]))
            assert torch.equal(frame["observation.state"], joints[step])
            assert torch.equal(frame["action"], joints[min(step + 1, len(item) - 1)])
            assert torch.equal(frame["observation.environment_state"], poses.float())
            assert bool(frame["event.close"]) == (step == len(item) // 2)
            assert frame["timestamp"].item() == np.float32(step / FPS)
            assert [frame[key].item() for key in NUMBERS] == [episode, row, step]
            assert frame["task"] == "reach"
            row += 1
    return dataset


def check_statistics(dataset):
    """Equal to LeRobot's own, but for the quantiles, which it takes from histograms."""
    features = dataset.meta.features
    rows = dataset.hf_dataset.with_format("numpy")[:]
    rows = {key: rows[key].reshape(len(dataset), -1) for key in features}
    theirs = compute_episode_stats(rows, features)
    for key in features:
        for name in ("min", "max", "mean", "std", "count"):
            ours = dataset.meta.stats[key][name]
            assert np.allclose(ours, theirs[key][name], rtol=1e-4, atol=1e-5), (key, name)


def record(dataset, item):
    joints = item.joints.float().numpy()
    for step, values in enumerate(joints):
        following = joints[min(step + 1, len(item) - 1)]
        dataset.add_frame({"observation.state": values, "action": following, "task": "reach"})
    dataset.save_episode()


def check_sets_of_lerobot(root, written):
    """A set that LeRobot made is read, and grows by our hand and by theirs."""
    names = list(written[0].joint_names)
    vector = {"dtype": "float32", "shape": (len(names),), "names": names}
    features = {"observation.state": vector, "action": vector}
    made = LeRobotDataset.create(
        "local/set", fps=FPS, features=features, root=root, use_videos=False
    )
    record(made, written[0])
    record(made, written[1])
    made.finalize()
    save_lerobot(written[2:3], root, fps=FPS, task="reach", append=True)
    assert len(opened(root)) == sum(map(len, written[:3]))
    grown = LeRobotDataset.resume("local/set", root=root)
    record(grown, written[3])
    grown.finalize()
    assert len(opened(root)) == sum(map(len, written))
    for found, expected in zip(load_lerobot(root), written, strict=True):
        assert_same(found, expected, 1e-6)


def check_added_frames(folder):
    """A set of LeRobot's with a video opens with an object's poses, pictures included."""
    names, rng = ["x", "y", "z"], np.random.default_rng(0)
    vector = {"dtype": "float32", "shape": (3,), "names": names}
    video = {"dtype": "video", "shape": (64, 96, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, "observation.images.top": video}
    made = LeRobotDataset.create(
        "local/set", fps=FPS, features=features, root=folder / "filmed"
    )
    for length in (8, 5):
        for _ in range(length):
            values = {
                name: rng.normal(size=3).astype(np.float32) for name in list(features)[:2]
            }
            picture = {"observation.images.top": rng.integers(0, 255, (64, 96, 3), np.uint8)}
            made.add_frame({**values, **picture, "task": "reach"})
        made.save_episode()
    made.finalize()
    poses = [Frame([0.3, 0.1, 0.0]), Frame([0.4, 0.2, 0.0])]
    copied, old = (
        opened(add_frames(folder / "filmed", folder / "copy", {"cup": poses})),
        opened(folder / "filmed"),
    )
    for row in range(13):
        after, before = copied[row], old[row]
        assert torch.equal(
            after.pop("observation.environment_state"), pose(poses[row > 7]).float()
        )
        for key, value in before.items():
            same = torch.equal(after[key], value) if isinstance(value, torch.Tensor) else True
            assert same, key
    assert len(LeRobotDataset("local/set", root=folder / "copy", episodes=[1])) == 5


def main(folder):
    written = [demonstration(seed, length=20 + seed) for seed in range(4)]
    for few in (written[:2], written[2:]):
        root = save_lerobot(few, folder / "ours", fps=FPS, task="reach", append=True)
    assert len(list(root.glob("data/*/*.parquet"))) > 1
    check_statistics(check_every_frame(root, written))
    some = LeRobotDataset("local/set", root=root, episodes=[1, 3])
    assert len(some) == len(written[1]) + len(written[3])
    wide = save_lerobot(written, folder / "wide", fps=FPS, task="reach", dtype="float64")
    check_every_frame(wide, written)
    bare = [Demonstration(d.time, d.joints, {}, d.joint_names) for d in written]
    check_sets_of_lerobot(folder / "theirs", bare)
    check_added_frames(folder)
    print("all equal", flush=True)
    # Threads of Arrow's scanner may abort a process that ends (apache/arrow issue 45214).
    os._exit(0)


main(Path(sys.argv[1]))

"""Damaged files give what was saved, or an error that says so: nothing else, and at once."""

import copy
import json
import re
from collections import Counter

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import lerobot_sets, skills
from tests.support.damage import (
    SIGNED,
    TABLES,
    TEXTS,
    WITH_JSON,
    blocks,
    bounded,
    damaged,
    one,
)
from tests.support.policies import ENVIRONMENT, STATE, act, batch, fitted
from tests.support.skills import hands
from tpgmm_control.loop.controller import Controller
from tpgmm_control.loop.rollout import rollout
from tpgmm_datasets import load_lerobot
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_datasets.situation_files import read_situations
from tpgmm_datasets.tables import (
    demonstrations_from_frame,
    demonstrations_to_frame,
    read_table,
    write_table,
)
from tpgmm_torch import Demonstration, Robot, Situation, load, save
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import TPGMMError
from tpgmm_torch.skills.via_points import ViaPoints

DEMONSTRATIONS = 50


def check_all(original, tmp_path, damages, seeds, read, check):
    """Load damaged copies; how many were refused."""
    outcome = Counter()
    for seed in seeds:
        with damaged(original, tmp_path, damages, seed) as (path, what):
            try:
                with bounded(what):
                    found = read(path)
            except TPGMMError as error:
                assert re.search(r"\w", str(error)), what
                outcome["refused"] += 1
            except BaseException as error:
                raise AssertionError(f"{type(error).__name__} after: {what}") from error
            else:
                assert check(found), f"wrong after: {what}"
                outcome["the same"] += 1
    assert outcome["refused"] > len(seeds) / 2, outcome
    return outcome


# Models


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "saved"
    save(hands(), path)
    return path


def same_model(found):
    expected = skills.hands()
    skills.same(found, expected)
    settings = [m.get_params(deep=False) for m in (found, expected)]
    for parameters in settings:
        del parameters["operators"], parameters["robot"]
    return (
        settings[0] == settings[1]
        and found.operators_ == expected.operators_
        and found.kinematics_ == expected.kinematics_
        and torch.equal(found.time_, expected.time_)
    )


@pytest.mark.parametrize("seeds", blocks(200, 5000), ids=str)
def test_models(model, tmp_path, seeds):
    check_all(model, tmp_path, WITH_JSON, seeds, load, same_model)


def middle(skill):
    """A posture within the limits, and objects."""
    robot = skill.kinematics
    joints = torch.zeros_like(robot.lower).clamp(robot.lower, robot.upper) + 0.1
    joints[[place + k for place in robot.quaternion_starts for k in range(4)]] = 0.5
    return joints, {name: Frame([0.3, 0.0, 0.1]) for name in skill.frame_names}


def runs(found):
    """Whether what was loaded can be run: a reproduction, and ticks of a controller."""
    skill = getattr(found, "skill", found)
    joints, frames = middle(skill)
    [whole] = rollout(skill, [Situation(joints, frames)], bounds="robot", blend=1.0)
    controller = Controller(skill, joints, frames)
    for _ in range(4):
        controller.step(0.02, controller.reference)
    return bool(whole.joints.isfinite().all()) and bool(controller.reference.isfinite().all())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seeds", blocks(150, 5000), ids=str)
@pytest.mark.parametrize("kind", ["model", "skill"])
def test_models_with_other_settings(kind, model, tmp_path, seeds):
    through = ViaPoints(hands().skill, ["1.0:position:left@cup=0.1,0.1,0.2"], 0.5)
    if kind == "skill":
        save(through, model := tmp_path / "skill")
    check_all(model, tmp_path, SIGNED, seeds, load, runs)


# Policies


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "saved"
    fitted().save_pretrained(path)
    return path


def same_policy(found):
    states = found.state_dict(), fitted().state_dict()
    return found.config == fitted().config and all(
        torch.equal(states[0][name], states[1][name]) for name in {**states[0], **states[1]}
    )


@pytest.mark.parametrize("seeds", blocks(20, 500), ids=str)
def test_policies(policy, tmp_path, seeds):
    check_all(policy, tmp_path, WITH_JSON, seeds, TPGMMPolicy.from_pretrained, same_policy)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seeds", blocks(40, 5000), ids=str)
def test_policies_with_other_settings(policy, tmp_path, seeds):
    observed = {key: value[:1] for key, value in batch().items()}
    shown = dict(zip(fitted().joints.state_names, observed[STATE][0].tolist(), strict=True))

    def acts(found):
        found.config.control.largest_start_gap = None  # in other units it stands elsewhere
        state = [shown.get(name, 0.0) for name in found.joints.state_names]
        pose = torch.nn.functional.pad(
            observed[ENVIRONMENT], (0, found.config.env_state_feature.shape[0] - 7)
        )
        given = {STATE: torch.tensor([state]), ENVIRONMENT: pose}
        return bool(act(found, given, 3).isfinite().all())

    check_all(policy, tmp_path, SIGNED, seeds, TPGMMPolicy.from_pretrained, acts)


# Data sets


def recorded():
    rng = np.random.default_rng(7)
    for length in (12, 9, 15):
        quaternion = rng.normal(size=(length, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        frames = {
            "bottle": Frame(rng.normal(size=3), quaternion[0]),
            "hand": Frame(rng.normal(size=(length, 3)), quaternion),
        }
        joints = rng.normal(size=(length, 3))
        yield Demonstration(
            np.arange(length) / 50, joints, frames, list("abc"), {"close": 5 / 50}
        )


def parts(demonstration):
    poses = [
        part
        for frame in demonstration.frames.values()
        for part in (frame.position, frame.orientation)
    ]
    return [demonstration.time, demonstration.joints, *poses]


def same_demonstrations(found, expected):
    return len(found) == len(expected) and all(
        a.joint_names == b.joint_names
        and dict(a.events) == dict(b.events)
        and list(a.frames) == list(b.frames)
        and all(map(torch.equal, parts(a), parts(b)))
        for a, b in zip(found, expected, strict=True)
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A set of this project's writer, whose pages and declarations carry check sums."""
    from tpgmm_datasets import save_lerobot

    root = tmp_path_factory.mktemp("written") / "set"
    first, *others = recorded()
    save_lerobot([first], root, fps=50, task="reach", robot_type="arm")
    return save_lerobot(others, root, fps=50, task="shake", append=True)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A set of layout v2.1, without any."""
    folder = tmp_path_factory.mktemp("foreign")
    lerobot_sets.write(folder / "new")
    return lerobot_sets.to_v21(folder / "new", folder / "set")


@pytest.mark.parametrize("seeds", blocks(60, 3000), ids=str)
def test_data_sets_with_check_sums(written, tmp_path, seeds):
    expected = load_lerobot(written)
    check_all(
        written,
        tmp_path,
        TABLES,
        seeds,
        load_lerobot,
        lambda d: same_demonstrations(d, expected),
    )


@pytest.mark.parametrize("seeds", blocks(40, 2000), ids=str)
def test_data_sets_without_check_sums(foreign, tmp_path, seeds):
    check_all(foreign, tmp_path, TABLES, seeds, load_lerobot, finite)


def finite(found):
    """Finite, of one robot, and on one time: more cannot be known."""
    return len(found) > 0 and all(
        len(d.joints) == len(d.time)
        and d.joint_names == found[0].joint_names
        and all(bool(part.isfinite().all()) for part in parts(d))
        and bool((d.time.diff() > 0).all())
        for d in found
    )


@pytest.mark.parametrize("seeds", blocks(100, 2000), ids=str)
def test_tables(tmp_path, seeds):
    original = tmp_path / "original"
    original.mkdir()
    write_table(demonstrations_to_frame(list(recorded())), original / "shown.csv")

    def read(path):
        return demonstrations_from_frame(read_table(path / "shown.csv"))

    check_all(original, tmp_path, TEXTS, seeds, read, finite)


# Situations


def test_situations(tmp_path):
    pose = {"position": [0.3, 0.0, 0.1], "orientation": [0.6, 0.0, 0.0, 0.8]}
    affine = {"A": [[1.0, 0.0], [0.0, 2.0]], "b": [0.1, 0.2]}
    given = [
        {"joints": [0.1, 0.2], "frames": {"cup": pose, "view": affine}},
        {"joints": {"elbow": 0.2, "shoulder": 0.1}, "time": [0.0, 0.5, 1.0]},
    ]
    original = tmp_path / "original"
    original.mkdir()
    (original / "situations.json").write_text(json.dumps(given))

    def read(path):
        return read_situations(path / "situations.json", ["shoulder", "elbow"])

    def whole(found):
        return all(bool(one.joints.isfinite().all()) and len(one.joints) == 2 for one in found)

    for seeds in blocks(100, 2000):
        check_all(original, tmp_path, WITH_JSON, seeds, read, whole)


# URDFs

WORDS = [
    "0", "-1", "1e200", "1e-200", "1e400", "nan", "inf", "", "0 0 0", "1 2", "9" * 5000,
    "fixed", "floating", "revolute", "prismatic", "continuous", "base", "&lt;", "\0", "é",
    "l_hand",
]  # fmt: skip


def changed_urdf(text, rng):
    """Bytes, attributes, elements and encodings changed; and what was done."""
    kind = one(["flip", "cut", "attribute", "element", "again", "word", "head"], rng)
    content = bytearray(text.encode())
    if kind == "flip":
        for _ in range(int(rng.integers(1, 4))):
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    elif kind == "cut":
        a, b = sorted(int(at) for at in rng.integers(len(content), size=2))
        del content[a:b]
    elif kind in ("attribute", "word"):
        found = one(list(re.finditer(r'="([^"]*)"', text)), rng)
        new = one(WORDS, rng)
        if kind == "word":
            new = one([m[1] for m in re.finditer(r'="([^"]*)"', text)], rng)
        content = bytearray((text[: found.start(1)] + new + text[found.end(1) :]).encode())
    elif kind in ("element", "again"):
        found = one(list(re.finditer(r"<[a-z][^>]*/>|<joint.*?</joint>", text, re.DOTALL)), rng)
        kept = 2 * found[0] if kind == "again" else ""
        content = bytearray((text[: found.start()] + kept + text[found.end() :]).encode())
    else:
        head = one(
            [
                b'<?xml version="1.0" encoding="utf-16"?>',
                b'<?xml version="1.0" encoding="hex"?>',
                b'<!DOCTYPE x [<!ENTITY a "b">]>',
                b"\xff\xfe",
                b"<a>" * 100_000,
            ],
            rng,
        )
        content[:0] = head
    return bytes(content), kind


@pytest.mark.parametrize("seeds", blocks(50, 500), ids=str)
def test_urdfs(tmp_path, seeds):
    original, outcome = upper_body_urdf(), Counter()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        content, kind = changed_urdf(original, rng)
        file = tmp_path / "robot.urdf"
        file.write_bytes(content)
        what = f"{kind} (seed {seed})"
        try:
            with bounded(what):
                robot = Robot.from_urdf(file, ["l_hand", "r_hand"])
                middle = (robot.lower + robot.upper).nan_to_num(0.0, 0.0, 0.0) / 2
                state = robot.state(middle)
                again = copy.deepcopy(robot)
        except TPGMMError:
            outcome["refused"] += 1
        except BaseException as error:
            raise AssertionError(f"{type(error).__name__} after: {what}") from error
        else:
            outcome["read"] += 1
            for part in (state.positions, state.orientations, state.jacobians):
                assert bool(part.isfinite().all()), what
            assert again == robot
    assert min(outcome["refused"], outcome["read"]) > len(seeds) / 10, outcome

"""Scenes: pairs that count, distances and their derivatives, the report of what touches."""

import importlib
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from tests.support.skills import few_bottles, small_bottle
from tests.support.worlds import upper_body
from tpgmm_control.obstacles import Scene, Shape, find_contacts
from tpgmm_control.obstacles.distances import Geometry
from tpgmm_datasets.bottle.skill import BottleShaking
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Frame, Hold, Robot, Sequence, ViaPoints, save
from tpgmm_torch.exceptions import (
    DataError,
    DependencyError,
    PlausibilityWarning,
    UnknownNameError,
)
from tpgmm_torch.persistence import load_skill

LINKS = ("l_hand", "r_hand")
#: A table, a ball, a post and a free cup, as MuJoCo reads them.
OBSTACLES = """<mujoco><worldbody>
<geom name="table" type="box" size="0.4 0.6 0.02" pos="0.5 0 0.03"/>
<body name="ball" pos="0.3 0.1 0.25"><geom size="0.06"/></body>
<body name="post" pos="0.25 -0.2 0.2" euler="0 30 10">
<geom type="capsule" size="0.03 0.2"/></body>
<body name="cup" pos="0.3 0 0.15"><freejoint/><geom type="cylinder" size="0.03 0.05"/></body>
</worldbody></mujoco>"""
TETRAHEDRON = "0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"


@pytest.fixture(scope="module")
def scene():
    return Scene(upper_body(), OBSTACLES, visuals=True)


def postures(robot, count, seed=0):
    share = torch.rand(count, robot.n_joints, generator=torch.Generator().manual_seed(seed))
    return torch.lerp(robot.lower, robot.upper, share.double())


def of_one_arm(shape="<sphere radius='0.05'/>", **settings):
    urdf = f"""<robot name="arm"><link name="base"/><link name="hand"><collision>
    <origin xyz="0.2 0 0"/><geometry>{shape}</geometry></collision></link>
    <joint name="turn" type="revolute"><parent link="base"/><child link="hand"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint></robot>"""
    return Robot.from_urdf(urdf, links=["hand"], **settings)


def test_no_contact_that_mujoco_finds_is_missed(scene):
    # the same robot and obstacles in one tree of MuJoCo's own
    spec = mujoco.MjSpec.from_string(upper_body_urdf())
    spec.compiler.discardvisual = False
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    around = mujoco.MjSpec.from_string(OBSTACLES)
    spec.attach(around, prefix="o/", frame=spec.worldbody.add_frame())
    model = spec.compile()
    data, robot, missed, found = mujoco.MjData(model), scene.robot, [], 0
    columns = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    cup = int(model.jnt_qposadr[model.body("o/cup").jntadr[0]])
    drawn = postures(robot, 1000)
    contacts = scene.distances(drawn, within=1e-3)
    known = {frozenset(pair) for pair in (*scene.pairs, *scene.allowed)}
    for row, joints in enumerate(drawn.numpy()):
        data.qpos[columns], data.qpos[cup : cup + 7] = joints, (0.3, 0, 0.15, 1, 0, 0, 0)
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            if contact.dist > -1e-6:
                continue
            bodies = [model.geom_bodyid[i] for i in contact.geom]
            names = [
                (model.body(body).name if body else model.geom(geom).name).removeprefix("o/")
                for body, geom in zip(bodies, contact.geom, strict=True)
            ]
            pair = tuple(sorted(names))
            if frozenset(pair) not in known or pair in scene.allowed:
                continue
            found += 1
            if not contacts.get(pair, np.ones(1000))[row] < 0:
                missed.append((row, pair, contact.dist))
    assert found > 1000
    assert missed == []


def test_rows_are_the_derivatives_of_distances(scene):
    geometry, step, checked = scene.geometry, 1e-6, 0
    joints = postures(scene.robot, 4, seed=1)
    objects = scene.objects(None, {}, 4)
    within = np.full((4, len(geometry.pairs)), 0.3)

    def measured(postures):
        placed = geometry.place(postures, objects)
        near = geometry.near(placed, within)
        return placed, near, dict(zip(zip(near.robot, near.pair), near.distance))  # noqa: B905

    placed, near, _ = measured(joints)
    rows = geometry.rows(placed, near)
    spheres = {i for i, one in enumerate(scene.shapes) if one.kind == "sphere"}
    for column in range(scene.robot.n_joints):
        moved = torch.zeros_like(joints)
        moved[:, column] = step
        more, less = measured(joints + moved)[2], measured(joints - moved)[2]
        for row, key in enumerate(zip(near.robot, near.pair)):  # noqa: B905
            # of solids with edges, nearest points jump
            smooth = spheres.issuperset(geometry.pairs[key[1]].tolist())
            if smooth and near.distance[row] > 1e-3 and key in more and key in less:
                slope = (more[key] - less[key]) / (2 * step)
                assert slope == pytest.approx(rows[row, column], abs=1e-6)
                checked += 1
    assert checked > 100


def test_bounds_never_exceed_distances(scene):
    joints = postures(scene.robot, 20, seed=2)
    placed = scene.geometry.place(joints, scene.objects(None, {}, 20))
    near = scene.geometry.near(placed, np.full((20, len(scene.pairs)), 2.0))
    least = scene.geometry.least(placed, near.robot, near.pair)
    assert (least <= np.maximum(near.distance, 0.0) + 1e-9).all()
    assert np.mean(least > 0.05) > 0.5  # most need no distance at all


def test_what_one_joint_connects_and_what_stands_still_is_no_pair(scene):
    pairs = set(scene.pairs)
    assert ("l_elbow_link", "l_upper_arm") not in pairs
    assert ("base", "table") not in pairs and ("ball", "table") not in pairs
    assert {("l_hand", "table"), ("l_hand", "r_hand"), ("ball", "cup")} <= pairs
    assert scene.allowed["l_forearm", "l_wrist_2"].startswith("always overlap")


def test_an_object_is_where_its_frame_is_and_moves_with_the_hand_that_holds_it():
    robot = of_one_arm()
    cup = Shape.sphere("cup", 0.02, [0.0, 0.0, 0.0], carrier="cup")
    scene = Scene(robot, [cup, Shape.box("wall", [0.1, 0.1, 0.1], [0.0, 0.35, 0.0])])
    time, joints = np.linspace(0, 1, 11), np.linspace(0, np.pi / 2, 11)[:, None]
    pose = {"cup": Frame([0.3, 0.0, 0.0])}
    assert find_contacts(scene, time, joints, pose) == []
    [contact] = find_contacts(scene, time, joints, pose, [Hold("cup", "hand", 0.0, 2.0)])
    assert str(contact) == "cup 20 mm inside wall at 1.0 s"
    with pytest.raises(DataError, match="where is the object 'cup'"):
        find_contacts(scene, time, joints)


def test_pairs_that_demonstrations_bring_near_are_allowed_by_name():
    skill = BottleShaking(rate=10)
    bottle = Shape.cylinder("bottle", 0.04, 0.2, [0.0, 0.0, 0.0], carrier="bottle")
    scene = Scene(skill.robot, [bottle, Shape.table(0.1)], visuals=True)
    shown = skill.demonstrations(2)
    allowing = scene.allowing(shown)
    assert allowing.allowed["bottle", "l_hand"] == "overlap by 1 mm in demonstrations"
    assert 0 < allowing.closer["l_forearm", "l_hand"] < 0.01
    assert ("bottle", "l_hand") in scene.pairs  # the first is as it was
    named = [pair for pair in allowing.allowed if "table" in pair]
    assert named == []  # nobody said that it stood there
    frames = shown[0].frames
    touched = {
        (one.one, one.other)
        for one in find_contacts(allowing, shown[0].time, shown[0].joints, frames)
    }
    assert ("r_hand", "table") in touched and ("l_hand", "bottle") not in touched


def test_a_saved_skill_allows_the_links_that_its_demonstrations_bring_near(tmp_path):
    save(small_bottle(), tmp_path / "model")
    skill = load_skill(tmp_path / "model")
    ball = Shape.sphere(
        "ball", 0.1, skill.kinematics.state(few_bottles()[0].joints[20]).positions[0]
    )
    scene = Scene(skill.kinematics, [ball], visuals=True)
    kept, shown = scene.allowing_skill(skill), scene.allowing(few_bottles())
    assert kept.allowed.keys() == shown.allowed.keys()
    assert len(shown.closer) > 3
    for pair, distance in shown.closer.items():  # half of what is known has to be kept
        assert distance <= kept.closer.get(pair, 0.02) < 2 * distance
    assert not [pair for pair in {*kept.closer, *kept.allowed} if "ball" in pair]
    both = ViaPoints(skill, []), Sequence([skill, skill])
    assert all(scene.allowing_skill(one).closer == kept.closer for one in both)
    older = replace(skill, summary=replace(skill.summary, postures=()))
    with pytest.warns(PlausibilityWarning, match="keeps no postures"):
        assert scene.allowing_skill(older) is scene


def test_the_robot_may_stand_in_the_file_and_excludes_allow_pairs():
    mjcf = """<mujoco><worldbody><geom name="wall" type="box" size=".1 .1 .1" pos="0 .35 0"/>
    <body name="base"><body name="hand"><geom pos="0.2 0 0" size="0.1"/>
    <joint name="turn" axis="0 0 1"/></body></body><body name="post" pos="0.2 0.2 0">
    <geom size="0.02"/></body></worldbody>
    <contact><exclude body1="hand" body2="post"/></contact></mujoco>"""
    scene = Scene(of_one_arm(), mjcf)
    assert scene.pairs == (("hand", "wall"),)
    assert scene.allowed == {("hand", "post"): "excluded"}
    assert scene.distances([[np.pi / 2]])["hand", "wall"] == pytest.approx([-0.05 - 0.1 + 0.1])


@pytest.mark.parametrize("inside", ["capsule", "cylinder"])
def test_lying_solids_reach_from_end_to_end(inside):
    ends = [0.0, 0.3, 0.5], [0.0, 0.3, 0.1]
    if inside == "capsule":
        solid = Shape.capsule("post", 0.05, *ends)
    else:
        solid = Shape.cylinder("post", 0.05, 0.4, [0.0, 0.3, 0.3])
    scene = Scene(of_one_arm(), [solid])
    end = 0.05 if inside == "capsule" else 0.0
    away = np.hypot(0.1 - end, 0) if inside == "cylinder" else None
    found = scene.distances([[np.pi / 2]])["hand", "post"]
    if away is None:
        assert found == pytest.approx([np.hypot(0.1, 0.1) - 0.1])
    else:
        assert found == pytest.approx([np.hypot(0.1, 0.05) - 0.05])


def test_meshes_are_read_from_their_folder(tmp_path):
    (tmp_path / "hand.obj").write_text(
        "".join(f"v {p}\n" for p in TETRAHEDRON.split("  "))
        + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    robot = of_one_arm('<mesh filename="package://arm/hand.obj"/>')
    with pytest.raises(DataError, match=r"'package://arm/hand.obj', which is not in sight"):
        Scene(robot, [Shape.table(-0.1)])
    ball = Shape.sphere("ball", 0.05, [0.5, 0.0, 0.0])
    scene = Scene(robot, [ball], meshes=tmp_path)
    assert scene.distances([[0.0]])["ball", "hand"] == pytest.approx([0.15])


def test_versions_of_mujoco_with_wrong_distances_are_refused(monkeypatch):
    monkeypatch.setattr(mujoco, "__version__", "3.11.0")
    with pytest.raises(DependencyError, match=r"MuJoCo 3.11.0 .*>=3.12"):
        Scene(of_one_arm(), [Shape.table(-0.1)])


def test_what_cannot_be_is_an_error():
    robot, bare = of_one_arm(), upper_body()
    with pytest.raises(DataError, match="only visuals: visuals=True takes these"):
        Scene(bare, [Shape.table(0.1)])
    with pytest.raises(UnknownNameError, match="'desk'"):
        Scene(robot, [Shape.table(0.1)], allowed=[("hand", "desk")])
    with pytest.raises(DataError, match="a pair is two names"):
        Scene(robot, [Shape.table(0.1)], allowed=[("hand", "table", "hand")])
    with pytest.raises(DataError, match="'ball' is a 'sphere'"):
        Shape.sphere("ball", float("nan"), [0, 0, 0])
    with pytest.raises(DataError, match="one position"):
        Shape.sphere("ball", 0.1, [[0, 0, 0]])
    with pytest.raises(DataError, match="one point to another"):
        Shape.capsule("post", 0.1, [0, 0, 0], [0, 0, 0])
    with pytest.raises(DataError, match="clearance"):
        Scene(robot, [Shape.table(0.1)], clearance=float("nan"))
    with pytest.raises(DataError, match="cannot compile"):
        Scene(robot, "<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>")


def test_without_mujoco_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(importlib.import_module("sys").modules, "mujoco", None)
    with pytest.raises(DependencyError, match="simulation"):
        Scene(of_one_arm(), [Shape.table(0.1)])


def test_a_robot_that_grips_in_its_own_unit_keeps_its_columns():
    robot = of_one_arm(coordinates=["gripper"], joints=["gripper", "turn"])
    scene = Scene(robot, [Shape.sphere("ball", 0.05, [0.0, 0.3, 0.0])])
    assert isinstance(scene.geometry, Geometry)
    near = scene.distances([[70.0, np.pi / 2]])["ball", "hand"]
    assert near == pytest.approx([0.0], abs=1e-9)

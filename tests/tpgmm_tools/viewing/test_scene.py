"""What is drawn is where the data and the kinematics put it."""

import copy
import re

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tests.support import skills
from tests.support.recordings import FPS, Recording
from tests.support.worlds import upper_body
from tpgmm_tools.viewing import ellipsoids, parse_shape, write_motion
from tpgmm_torch import Frame, Hold, Robot, Situation, quaternions
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots.urdf import read_urdf


def steps(trajectory):
    """Time steps that are shown at FPS, and their instants in the recording."""
    start, end = float(trajectory.time[0]), float(trajectory.time[-1])
    wanted = np.append(np.arange(start, end, 1 / FPS), end)
    chosen = np.unique(np.searchsorted(trajectory.time.numpy(), wanted))
    return chosen, (trajectory.time[chosen] - trajectory.time[0]).numpy()


def test_every_link_of_the_robot_is_where_its_joints_put_it(bottle):
    recording, trajectory, _ = bottle
    links = read_urdf(upper_body().config()["urdf"]).links
    whole = Robot.from_urdf(upper_body().config()["urdf"], links)
    chosen, instants = steps(trajectory)
    assert recording.duration == pytest.approx(instants[-1] + 1.0)
    state = whole.state(trajectory.joints[chosen])
    for number in (0, 5, len(chosen) - 1):
        for link in links:
            pose = recording.pose(f"/robot/{link}", instants[number])
            expected = torch.cat((state.position(link), state.orientation(link)), -1)[number]
            # viser leaves out moves that are smaller than numpy's allclose sees
            np.testing.assert_allclose(pose, expected, atol=2e-5, err_msg=link)
    shapes = {node for node in recording.nodes if re.fullmatch(r"/robot/\w+/\d", node)}
    assert len(shapes) == 21


def test_paths_and_frames_are_those_of_the_data(bottle):
    recording, trajectory, _ = bottle
    path = upper_body().state(trajectory.joints).position("r_hand")
    drawn = recording.props("/reproduction/r_hand")["points"].reshape(-1, 2, 3)
    assert len(drawn) >= 200
    np.testing.assert_array_equal(drawn[1:, 0], drawn[:-1, 1])
    np.testing.assert_allclose(drawn[[0, -1], [0, 1]], path[[0, -1]], atol=1e-6)
    # it goes through every time step, and around corners
    gaps = torch.cdist(path, torch.tensor(drawn[:, 0]).double()).min(dim=1).values
    steps_of_path = path.diff(dim=0).norm(dim=-1)
    assert float(gaps.max()) < 0.1 * float(steps_of_path.max())
    turns = np.diff(drawn[:, 1] - drawn[:, 0], axis=0)
    chords = np.diff(path, n=2, axis=0)
    assert np.linalg.norm(turns, axis=1).max() < 0.1 * np.linalg.norm(chords, axis=1).max()
    demonstrations = skills.few_bottles()
    shown = recording.props("/demonstrations/l_hand")["points"].reshape(-1, 2, 3)
    expected = [upper_body().state(one.joints).position("l_hand") for one in demonstrations]
    np.testing.assert_allclose(shown[0, 0], expected[0][0], atol=1e-6)
    np.testing.assert_allclose(shown[-1, 1], expected[-1][-1], atol=1e-6)
    bottle_frame = demonstrations[1].frames["bottle"]
    expected = torch.cat((bottle_frame.position, bottle_frame.orientation))
    np.testing.assert_allclose(recording.pose("/frames/bottle", 3.0), expected)
    assert recording.props("/frames/bottle/label")["text"] == "bottle"
    before = recording.props("/demonstrations/bottle")["batched_positions"].reshape(-1, 3)
    np.testing.assert_allclose(before[1], bottle_frame.position, atol=1e-6)


def test_ellipsoids_are_drawn_along_the_path(bottle):
    recording, trajectory, _ = bottle
    chosen, _ = steps(trajectory)
    drawn = recording.props("/covariance/r_hand")
    few = chosen[np.linspace(0, len(chosen) - 1, min(40, len(chosen))).astype(int)]
    state = upper_body().state(trajectory.joints[few])
    half_axes, turns = ellipsoids(state, trajectory.covariance[few], "r_hand")
    centres = drawn["batched_positions"].reshape(-1, 3)
    np.testing.assert_allclose(centres, state.position("r_hand"), atol=1e-6)
    scales = drawn["batched_scales"].reshape(-1, 3)
    np.testing.assert_allclose(scales, half_axes.clip(min=5e-4), atol=1e-6)
    np.testing.assert_allclose(drawn["batched_wxyzs"].reshape(-1, 4), turns, atol=1e-6)


def test_an_ellipsoid_holds_the_share_of_a_gaussian_that_it_should():
    robot, generator = upper_body(), torch.Generator().manual_seed(0)
    joints = torch.linspace(-0.2, 0.2, 17, dtype=torch.float64)
    root = 1e-4 * torch.randn(17, 17, dtype=torch.float64, generator=generator)
    half_axes, turn = ellipsoids(robot.state(joints), root @ root.T, "l_hand")
    assert bool((half_axes.diff() >= 0).all())
    draws = torch.randn(20_000, 17, dtype=torch.float64, generator=generator) @ root.T
    centre, around = (robot.state(q).position("l_hand") for q in (joints, joints + draws))
    seen = quaternions.rotate(quaternions.conjugate(turn), around - centre) / half_axes
    inside = (torch.linalg.vector_norm(seen, dim=-1) < 1).double().mean()
    assert float(inside) == pytest.approx(chi2.cdf(2.0**2, df=3), abs=0.01)
    # and its axes are the principal ones: what is seen along them is uncorrelated
    torch.testing.assert_close(
        torch.cov(seen.T), torch.eye(3, dtype=torch.float64) / 4, atol=5e-3, rtol=0
    )


def test_tracked_poses_and_moving_frames_are_shown_too(tmp_path):
    model = skills.hands_model().fit(skills.handlings(moves=True))
    situation, _ = skills.new_handling(moves=True)
    trajectory = write_motion(tmp_path / "m.html", model, situation, fps=5)
    recording = Recording(tmp_path / "m.html")
    last = trajectory.joints[-1]
    np.testing.assert_allclose(recording.pose("/robot/right", 2.0)[:3], last[7:10], atol=2e-5)
    for at, step in ((0.0, 0), (2.0, -1)):
        position = situation.frames["cup"].position[step]
        np.testing.assert_allclose(recording.pose("/frames/cup", at)[:3], position, atol=2e-5)
    assert "demonstrations" not in recording.page.rpartition("<b>tpgmm</b>")[2]
    assert not any(node.startswith("/demonstrations") for node in recording.nodes)


def test_objects_have_the_shapes_that_were_given_and_go_with_their_frame(tmp_path):
    model = skills.hands_model().fit(skills.handlings(moves=True))
    situation, _ = skills.new_handling(moves=True)
    shape = parse_shape("cylinder:0.03,0.2")
    write_motion(tmp_path / "m.html", model, situation, objects={"cup": shape}, fps=5)
    recording = Recording(tmp_path / "m.html")
    drawn = recording.props("/frames/cup/shape")  # below the frame's node: it moves with it
    assert (drawn["radius"], drawn["height"]) == (0.03, 0.2)
    write_motion(tmp_path / "m.html", model, situation, fps=5)
    edges = Recording(tmp_path / "m.html").props("/frames/cup/shape")["dimensions"]
    assert len(set(edges)) == 1
    with pytest.raises(DataError, match=r"shapes for \['mug'\].*\['cup'\]"):
        write_motion(tmp_path / "m.html", model, situation, objects={"mug": shape})


def test_what_is_held_goes_with_the_hand_and_stays_where_it_is_put(tmp_path):
    model = copy.copy(skills.small_bottle())
    model.holds_ = (Hold("bottle", "l_hand", 5.0, 9.0),)
    one = skills.few_bottles()[1]
    situation = Situation(one.joints[0], one.frames)
    trajectory = write_motion(tmp_path / "m.html", model, situation, fps=5)
    recording = Recording(tmp_path / "m.html")
    state = upper_body().state(trajectory.joints)
    hand = Frame(state.position("l_hand"), state.orientation("l_hand"))
    seen = {}
    for at in (0.0, 3.0, 6.0, 8.0, 10.0, 12.0):
        pose = recording.pose("/frames/bottle", at)
        seen[at] = Frame(pose[:3], pose[3:])
    start = one.frames["bottle"]
    for at in (0.0, 3.0):
        np.testing.assert_allclose(seen[at].position, start.position, atol=1e-5)
    assert float((seen[8.0].position - start.position).norm()) > 0.02
    np.testing.assert_allclose(seen[12.0].position, seen[10.0].position, atol=1e-5)
    in_hand = {}
    for at in (6.0, 8.0):
        shown = int((trajectory.time - trajectory.time[0] < at - 1e-6).sum())
        in_hand[at] = seen[at].seen_from(hand[shown])
    np.testing.assert_allclose(in_hand[6.0].position, in_hand[8.0].position, atol=1e-3)


def test_situations_stand_side_by_side_and_move_at_once(tmp_path):
    model, shown = skills.small_bottle(), skills.few_bottles()[:2]
    situations = [Situation(one.joints[0], one.frames) for one in shown]
    write_motion(tmp_path / "m.html", model, situations, fps=2)
    recording = Recording(tmp_path / "m.html")
    np.testing.assert_allclose(recording.pose("/1", 0.0)[[0, 2]], 0)
    assert recording.pose("/1", 0.0)[1] > 0.5
    for root, one in zip(("", "/1"), shown, strict=True):
        position = one.frames["bottle"].position
        np.testing.assert_allclose(
            recording.pose(f"{root}/frames/bottle", 0.0)[:3], position, atol=1e-6
        )
    [alone] = model.predict([situations[1]])
    hand = upper_body().state(alone.joints[-1]).position("l_hand")
    np.testing.assert_allclose(
        recording.pose("/1/robot/l_hand", recording.duration)[:3], hand, atol=2e-5
    )


def test_joints_alone_have_nothing_to_show(tmp_path):
    model = skills.canonical().fit(skills.waves())
    with pytest.raises(DataError, match=r"joints only.*--link NAME"):
        write_motion(tmp_path / "m.html", model, Situation([0.0, 0.0, 0.0]))
    assert list(tmp_path.iterdir()) == []


#: A triangle in millimetres, 100 of them up.
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2026-01-01T00:00:00Z</created><modified>2026-01-01T00:00:00Z</modified>
<unit name="millimeter" meter="0.001"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="a" count="9">0 0 0 10 0 0 0 20 0</float_array>
<technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><translate>0 0 100</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.fixture
def collada(tmp_path):
    """The demonstrations, a model of them whose arm has a mesh in COLLADA, and its folder."""
    (tmp_path / "arm.dae").write_text(DAE)
    urdf = """<robot name="r"><link name="base"/><link name="arm"><visual><geometry>
<mesh filename="package://r/arm.dae" scale="1 2 1"/></geometry></visual></link>""" + "".join(
        f"""<link name="{n}_"/><joint name="{n}" type="revolute"><parent link="{up}"/>
<child link="{"arm" if n == "a" else n + "_"}"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" velocity="9" effort="9"/></joint>"""
        for n, up in (("a", "base"), ("b", "arm"), ("c", "b_"))
    ).replace('<link name="a_"/>', "")
    shown = skills.waves()
    robot = Robot.from_urdf(urdf + "</robot>", links=["arm"])
    return shown, skills.canonical(n_components=2, robot=robot).fit(shown), tmp_path


def test_meshes_in_collada_are_drawn_in_their_unit(collada):
    shown, model, folder = collada
    write_motion(folder / "m.html", model, Situation.of(shown[0]), meshes=folder, fps=FPS)
    vertices = Recording(folder / "m.html").props("/robot/arm/0")["vertices"].reshape(-1, 3)
    expected = [(0, 0, 0.1), (0.01, 0, 0.1), (0, 0.04, 0.1)]
    np.testing.assert_allclose(vertices, expected, atol=1e-7)


def test_without_pycollada_it_says_what_to_install(collada, monkeypatch):
    import trimesh

    def missing(file):
        raise ImportError("missing `pip install pycollada`")

    shown, model, folder = collada
    monkeypatch.setattr(trimesh, "load_mesh", missing)
    with pytest.raises(DependencyError, match=r"arm\.dae needs .*tpgmm-torch\[collada\]"):
        write_motion(folder / "m.html", model, Situation.of(shown[0]), meshes=folder, fps=FPS)

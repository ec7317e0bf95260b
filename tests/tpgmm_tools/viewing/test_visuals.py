"""What a robot looks like: shapes read from a URDF, and sticks where there are none."""

import numpy as np
import pytest
import torch

from tests.support.worlds import upper_body
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_tools.viewing import link_shapes, parse_shape
from tpgmm_tools.viewing.visuals import mesh, whole_body
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError, DependencyError
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.urdf import read_urdf


def robot(visuals: str, extra: str = "", materials: str = "") -> str:
    """Two links, ``arm`` with the visuals, and a tip that hangs at (0.3, 0, 0.4) of it."""
    return f"""<robot name="r">{materials}<link name="base"/><link name="arm">{visuals}</link>
<link name="tip"/>{extra}
<joint name="a" type="revolute"><parent link="base"/><child link="arm"/>
  <axis xyz="0 0 1"/></joint>
<joint name="b" type="revolute"><parent link="arm"/><child link="tip"/>
  <origin xyz="0.3 0 0.4"/><axis xyz="0 1 0"/></joint></robot>"""


def visual(inside: str) -> str:
    return f"<visual>{inside}</visual>"


def geometry(inside: str) -> str:
    return f"<geometry>{inside}</geometry>"


MESH = visual(geometry('<mesh filename="package://robot/meshes/arm.stl" scale="2 2 3"/>'))


def shapes(urdf: str, meshes=None):
    return link_shapes(read_urdf(urdf), meshes)


def test_the_upper_body_has_a_shape_for_every_link():
    found = shapes(upper_body_urdf())
    assert set(found) == set(read_urdf(upper_body_urdf()).links)
    [hand] = found["l_hand"]
    assert (hand.kind, hand.size, hand.opacity) == ("box", (0.05, 0.02, 0.08), 1.0)
    block, head = found["torso"]
    assert (head.kind, head.size) == ("sphere", (0.06,))
    np.testing.assert_allclose(block.pose[:3, 3], (-0.03, 0, 0.11))
    [shoulder] = found["l_shoulder_1"]
    assert (shoulder.kind, shoulder.size) == ("cylinder", (0.035, 0.07))
    # its origin is turned by a quarter about x: the cylinder lies along y
    np.testing.assert_allclose(shoulder.pose[:3, 2], (0, -1, 0), atol=1e-12)


def test_colours_come_from_the_visual_or_by_name_from_the_robot():
    ball = geometry('<sphere radius="1"/>')
    named = '<material name="red"><color rgba="1 0 0 0.5"/></material>'
    own = visual(ball + '<material name="x"><color rgba="0 0.2 1 1"/></material>')
    by_name = visual(ball + '<material name="red"/>')
    unknown = visual(ball + '<material name="green"/>')
    found = shapes(robot(own + by_name + unknown, materials=named))["arm"]
    assert [shape.color for shape in found[:2]] == [(0, 51, 255), (255, 0, 0)]
    assert [shape.opacity for shape in found[:2]] == [1.0, 0.5]
    assert found[2].color == shapes(robot(visual(ball)))["arm"][0].color


@pytest.mark.parametrize("visuals", [MESH, ""], ids=["a mesh without its file", "no visual"])
def test_a_link_that_cannot_be_drawn_becomes_sticks_to_its_joints(visuals):
    found = shapes(robot(visuals))
    [stick] = found["arm"]
    assert stick.kind == "cylinder"
    assert stick.size[1] == pytest.approx(0.5)
    ends = [stick.pose @ (0, 0, z, 1) for z in (-0.25, 0.25)]
    np.testing.assert_allclose(ends, [(0, 0, 0, 1), (0.3, 0, 0.4, 1)], atol=1e-12)
    turn = stick.pose[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    # only a robot without any visual is all sticks: else links without one are just frames
    assert set(found) == ({"arm"} if visuals else {"base", "arm", "tip"})


@pytest.mark.parametrize("place", ["robot/meshes", "meshes", "."])
def test_a_mesh_is_looked_for_by_the_end_of_its_name(tmp_path, place):
    file = tmp_path / place / "arm.stl"
    file.parent.mkdir(parents=True, exist_ok=True)
    with pytest.raises(DataError, match=r"mesh 'package://.*' of link 'arm' is not in the"):
        shapes(robot(MESH), tmp_path)
    file.write_text("")
    [found] = shapes(robot(MESH), tmp_path)["arm"]
    assert (found.kind, found.size, found.file) == ("mesh", (2.0, 2.0, 3.0), file)


@pytest.mark.parametrize(
    ("inside", "complaint"),
    [
        ("", r"needs one <box>, .* got \[\]"),
        (geometry('<capsule radius="1"/>'), r"got \['capsule'\]"),
        (geometry('<box size="1 2"/>'), r"<box size> needs 3 finite number\(s\), got '1 2'"),
        (geometry('<sphere radius="big"/>'), r"<sphere radius> needs 1 .* got 'big'"),
        (geometry('<sphere radius="nan"/>'), r"<sphere radius> needs 1 .* got 'nan'"),
        (geometry("<cylinder length='1'/>"), r"<cylinder radius> needs 1 .* got None"),
    ],
)
def test_a_visual_that_is_none_is_refused(inside, complaint):
    with pytest.raises(DataError, match=f"link 'arm'.*{complaint}"):
        shapes(robot(visual(inside)))


def test_the_whole_body_follows_the_joints_of_the_model():
    body, drawn = whole_body(upper_body())
    assert body.links[:2] == upper_body().links
    assert set(body.links) == set(drawn) == set(read_urdf(upper_body_urdf()).links)
    assert body.joint_names == upper_body().joint_names
    hands = Poses(("left", "right"), dtype=torch.float32)
    body, drawn = whole_body(hands)
    assert (body.links, body.lower.dtype, drawn) == (hands.links, torch.float64, {})


def test_of_a_body_only_what_the_base_holds_is_drawn():
    box = visual(geometry('<box size="1 1 1"/>'))
    extra = f"""<link name="cart">{box}</link>
<joint name="free" type="floating"><parent link="tip"/><child link="cart"/></joint>"""
    urdf = robot(visual(geometry('<sphere radius="0.1"/>')), extra)
    body, drawn = whole_body(Robot.from_urdf(urdf, ["arm"], base="tip", dtype=torch.float32))
    assert (body.links, set(drawn)) == (("arm",), {"arm"})
    assert body.state([0.0, 0.0]).positions.dtype == torch.float64


@pytest.mark.parametrize(
    "text",
    ["", "box", "box:1,2", "sphere:1,2", "cone:1,2", "sphere:-1", "sphere:nan", "box:a,b,c"],
)
def test_a_shape_that_is_none_is_refused(text):
    with pytest.raises(DataError, match="a shape is box:X,Y,Z"):
        parse_shape(text)


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


def test_meshes_in_collada_are_read_in_their_unit(tmp_path, monkeypatch):
    import trimesh

    (tmp_path / "arm.dae").write_text(DAE)
    [shape] = shapes(robot(MESH.replace(".stl", ".dae")), tmp_path)["arm"]
    vertices, _ = mesh(shape)
    np.testing.assert_allclose(vertices, [(0, 0, 0.3), (0.02, 0, 0.3), (0, 0.04, 0.3)])

    def missing(file):
        raise ImportError("missing `pip install pycollada`")

    monkeypatch.setattr(trimesh, "load_mesh", missing)
    with pytest.raises(DependencyError, match=r"arm\.dae needs .*tpgmm-torch\[collada\]"):
        mesh(shape)
    (tmp_path / "arm.dae").write_text("no mesh")
    monkeypatch.undo()
    with pytest.raises(DataError, match=r"arm\.dae cannot be read"):
        mesh(shape)

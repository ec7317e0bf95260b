"""The URDF reader: what it reads, and what it refuses."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.support.refusals import refused
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.urdf import Mimic, read_urdf

LINKS = '<link name="a"/><link name="b"/><link name="c"/>'


def joint(name: str, parent: str, child: str, inside: str = "", kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{inside}</joint>"
    )


def urdf(*parts: str, links: str = LINKS) -> str:
    return f'<robot name="r">{links}{"".join(parts)}</robot>'


def one(inside: str = "", kind: str = "revolute") -> str:
    return urdf(joint("j", "a", "b", inside, kind), links='<link name="a"/><link name="b"/>')


class TestReading:
    def test_names_are_in_document_order(self) -> None:
        model = read_urdf(urdf(joint("two", "b", "c"), joint("one", "a", "b", kind="fixed")))
        assert (model.name, model.root, model.links) == ("r", "a", ("a", "b", "c"))
        assert [j.name for j in model.joints] == ["two", "one"]
        assert model.actuated_joints == ("two",)

    def test_one_given_limit_sets_the_other_to_zero(self) -> None:
        (j,) = read_urdf(one('<limit upper="2" effort="1" velocity="3"/>')).joints
        assert (j.lower, j.upper, j.velocity) == (0, 2, 3)

    def test_limits_of_later_versions_are_read(self) -> None:
        (j,) = read_urdf(one('<limit acceleration="5" deceleration="4" jerk="60"/>')).joints
        assert (j.velocity, j.acceleration, j.jerk) == (math.inf, 4, 60)
        (j,) = read_urdf(one('<limit velocity="1" acceleration="5"/>')).joints
        assert (j.velocity, j.acceleration, j.jerk) == (1, 5, math.inf)

    def test_continuous_joints_have_no_range(self) -> None:
        (j,) = read_urdf(one('<limit lower="-1" upper="1" velocity="3"/>', "continuous")).joints
        assert (j.lower, j.upper, j.velocity) == (-math.inf, math.inf, 3)

    @pytest.mark.parametrize("rate", ["0", "-1"])
    def test_limits_that_cannot_be_are_none(self, rate: str) -> None:
        limit = f'<limit lower="1" upper="0" velocity="{rate}" acceleration="{rate}"/>'
        (j,) = read_urdf(one(limit)).joints
        assert (j.lower, j.upper, j.velocity, j.acceleration) == (-math.inf, *[math.inf] * 3)
        told = (f'velocity="{rate}"', f'acceleration="{rate}"', 'lower="1" upper="0"')
        assert j.doubts == told

    def test_limits_that_are_not_numbers_are_none(self) -> None:
        (j,) = read_urdf(one('<limit lower="${-pi}" upper="1" velocity="" jerk="x"/>')).joints
        assert (j.lower, j.upper, j.velocity, j.jerk) == (-math.inf, *[math.inf] * 3)
        assert j.doubts == ('velocity=""', 'jerk="x"', 'lower="${-pi}" upper="1"')

    def test_zeros_that_nobody_filled_in_are_none_and_a_single_point_is_one(self) -> None:
        (j,) = read_urdf(one('<limit lower="0" upper="0" effort="0" velocity="0"/>')).joints
        assert (j.lower, j.upper) == (-math.inf, math.inf)
        (j,) = read_urdf(one('<limit lower="0" upper="0" velocity="1"/>')).joints
        assert (j.lower, j.upper, j.doubts) == (0, 0, ())

    @pytest.mark.parametrize(("before", "inside"), [
        ("", '<gazebo sim:kind="sonar"/><sim:world/>'),
        ("\r\n\n <?xml version='1.0'?>\r\n", ""),
        ("<!-- of -- us ---><?xml?>", "<!-- <!-- a -- b --> <?pi?>"),
        ("<?xml version='1.0' encoding='utf-16'?>", "<!-- \f\0 -->"),
        ("", '<material name="R&D &amp; &copy; &#233;"/>'),
    ])  # fmt: skip
    def test_what_readers_of_urdf_pass_over_means_nothing(
        self, before: str, inside: str
    ) -> None:
        plain = one(inside).replace("<robot", '<robot xmlns="http://a" xmlns:sim="http://b"')
        for text in (before + plain, before + plain.replace(' xmlns:sim="http://b"', "")):
            assert read_urdf(text).actuated_joints == ("j",)
            assert read_urdf(text.encode("utf-8-sig")).links == ("a", "b")

    @pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
    def test_what_is_not_utf_8_is_latin_1(self, mark: bytes) -> None:
        text = one("<!-- Caf\xe9 -->").replace('"b"', '"H\xe4nd"')
        assert read_urdf(mark + text.encode("latin-1")).links == ("a", "H\xe4nd")

    def test_comments_without_an_end_take_no_time(self) -> None:
        with pytest.raises(DataError, match="not well-formed"):
            read_urdf("<robot>" + "<!-- <? " * 300_000)

    def test_macros_left_over_are_told_and_passed_over(self) -> None:
        macro = '<xacro:macro name="m"><link name="${p}"/></xacro:macro><xacro:property/>'
        model = read_urdf(one(macro))
        assert model.links == ("a", "b")
        assert model.doubts == ("xacro:macro, xacro:property left over (xacro expands them)",)

    def test_origin_turns_about_fixed_axes_x_then_y_then_z(self) -> None:
        (j,) = read_urdf(one('<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>')).joints

        def turn(axis: int, angle: float) -> np.ndarray:
            matrix = np.eye(3)
            i, k = [index for index in range(3) if index != axis]
            sign = -1 if axis == 1 else 1
            matrix[i, i] = matrix[k, k] = math.cos(angle)
            matrix[k, i] = sign * math.sin(angle)
            matrix[i, k] = -matrix[k, i]
            return matrix

        expected = turn(2, 0.3) @ turn(1, 0.2) @ turn(0, 0.1)
        np.testing.assert_allclose(j.origin[:3, :3], expected, atol=1e-15)
        assert j.origin[:3, 3].tolist() == [1, 2, 3]
        assert j.origin[3].tolist() == [0, 0, 0, 1]

    def test_axes_become_unit_vectors(self) -> None:
        for scale in ("", "e200", "e-200"):  # of which the squares are no float64
            (j,) = read_urdf(one(f'<axis xyz="0 3{scale} 4{scale}"/>')).joints
            assert j.axis.tolist() == pytest.approx([0, 0.6, 0.8], abs=1e-15)

    def test_leaders_are_found_through_followers(self) -> None:
        links = LINKS + '<link name="d"/>'
        second = joint("second", "b", "c", '<mimic joint="first" multiplier="2" offset="1"/>')
        third = joint("third", "c", "d", '<mimic joint="second" multiplier="-3"/>')
        model = read_urdf(urdf(joint("first", "a", "b"), second, third, links=links))
        assert model.actuated_joints == ("first",)
        assert model.leader("third") == Mimic("first", -6, -3)
        assert model.leader("first") == Mimic("first", 1, 0)

    @pytest.mark.parametrize(("leaders", "lost"), [
        (("two", "one"), "one, two"),
        (("one", None), "one"),
        ((None, "two"), "two"),
        (("two", "three"), "two"),
        (("weld", "one"), "one"),
    ])  # fmt: skip
    def test_mimicry_of_nothing_that_moves_is_told_and_passed_over(
        self, leaders: tuple[str | None, str | None], lost: str
    ) -> None:
        one, two = (f'<mimic joint="{leader}"/>' if leader else "" for leader in leaders)
        parts = joint("one", "a", "b", one), joint("two", "b", "c", two)
        weld = joint("weld", "c", "d", kind="fixed")
        model = read_urdf(urdf(*parts, weld, links=LINKS + '<link name="d"/>'))
        assert model.doubts == (f"mimicry of what does not move, or in a circle, by {lost}",)
        for name in lost.split(", "):
            assert model.leader(name) == Mimic(name)

    def test_paths_strings_and_bytes_give_the_same(self, tmp_path: Path) -> None:
        text = upper_body_urdf()
        path = tmp_path / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        sources = (text, "\ufeff\n" + text, text.encode(), text.encode("utf-8-sig"), path)
        models = [read_urdf(source) for source in (*sources, str(path))]
        assert {model.text for model in models} == {text}
        assert {model.root for model in models} == {"base"}


class TestRefusing:
    @pytest.mark.parametrize(("text", "message"), [
        ("<robot", "not well-formed XML"),
        ("<urdf/>", "root element <robot>, got <urdf>"),
        ("<robot/>", "0 links"),
        (urdf(links="<link/>"), "<link> number 1 of the URDF has no name"),
        (urdf(links=LINKS + '<link name="a"/>'), "two links named 'a'"),
        (urdf(joint("j", "a", "b"), joint("j", "b", "c")), "two joints named 'j'"),
        (one().replace('name="j"', ""), "<joint> number 1 of the URDF has no name"),
        (one().replace('type="revolute"', ""), "joint 'j' has type ''"),
        (one(kind="hinge"), "joint 'j' has type 'hinge'; URDF knows .*'revolute'"),
        (one().replace('<parent link="a"/>', ""), "joint 'j' has no parent link"),
        (one().replace('<child link="b"/>', "<child/>"), "joint 'j' has no child link"),
        (urdf(joint("j", "a", "c"), joint("k", "b", "c")), "'c' is the child of two"),
        (urdf(joint("j", "a", "b")), r"2 links without a parent, not one: \['a', 'c'\]"),
        (urdf(joint("j", "a", "a")), r"2 links without a parent, not one: \['b', 'c'\]"),
        (urdf(joint("j", "b", "c"), joint("k", "c", "b")), r"cycle of .* \['b', 'c'\]"),
        (urdf(joint("j", "a", "a"), links='<link name="a"/>'), r"cycle of .* \['a'\]"),
        (one('<axis xyz="0 0 0"/>'), "joint 'j' has the axis 0 0 0"),
        (one('<axis xyz="0 1"/>'), "<axis xyz> needs 3 finite number.*got '0 1'"),
        (one('<origin xyz="0 nan 0"/>'), "<origin xyz> needs 3 finite"),
        (one('<origin rpy="0 ${pi} 0"/>'), "<origin rpy> needs 3 finite"),
        (one('<origin xyz="0 1e200 0"/>'), "up to 1.84e.19, got '0 1e200 0'"),
        (one("<mimic/>"), "<mimic> does not name a joint"),
        (one('<mimic joint="j" offset="x"/>'), "<mimic offset>"),
        ('<robot xmlns:xacro="http://ros.org/xacro"><xacro:arm/></robot>', "xacro macros"),
        ("<robot><xacro:arm/></robot>", r"expand them first \(xacro FILE > ROBOT"),
        (one('<origin rpy="0 0 $(arg yaw)"/>'), "xacro macros.*finite number"),
    ])  # fmt: skip
    def test_broken_descriptions(self, text: str, message: str) -> None:
        refused(lambda: read_urdf(text), DataError, message)

    @pytest.mark.parametrize("ends", [("a", "hand"), ("hand", "a")])
    def test_links_that_do_not_exist(self, ends: tuple[str, str]) -> None:
        message = r"link 'hand' is not in the URDF \(joint 'j'\); it has \['a', 'b', 'c'\]"
        refused(lambda: read_urdf(urdf(joint("j", *ends))), UnknownNameError, message)

    @pytest.mark.parametrize("entities", [
        '<!ENTITY a "1"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">',
        '<!ENTITY secret SYSTEM "file:///etc/hostname">',
        "",
    ])  # fmt: skip
    def test_document_types_are_refused_before_they_expand(self, entities: str) -> None:
        text = f"<!DOCTYPE robot [{entities}]>" + one()
        refused(lambda: read_urdf('<?xml version="1.0"?>' + text), DataError, "document type")
        refused(lambda: read_urdf(text), DataError, "document type")

    def test_files_that_are_not_there(self, tmp_path: Path) -> None:
        for source in (tmp_path / "none.urdf", str(tmp_path), "none\0.urdf", ""):
            refused(lambda source=source: read_urdf(source), DataError, "cannot be read")

    def test_bytes_that_are_not_text(self) -> None:
        refused(lambda: read_urdf(b"\xff\xfe<\x00"), DataError, "not UTF-8 text")

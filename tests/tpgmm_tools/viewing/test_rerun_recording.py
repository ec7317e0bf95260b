"""A Rerun recording holds what the page shows, read back by Rerun's own reader."""

import copy
import re
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from tests.support import skills
from tests.support.worlds import upper_body
from tpgmm_tools.viewing import parse_shape, write_rerun
from tpgmm_tools.viewing.curves import motion_marks, motion_panels
from tpgmm_torch import Situation, TaskParameterizedGMM


class Marked(TaskParameterizedGMM):
    """A model whose demonstrations name an event."""

    @property
    def skill(self):
        learned = super().skill
        return replace(learned, summary=replace(learned.summary, events={"grasp": 0.4}))


def with_an_event():
    model = copy.copy(skills.small_bottle())
    model.__class__ = Marked
    return model


@pytest.fixture(scope="module")
def chunks(tmp_path_factory):
    """Columns by entity, (instants, values) where there is a time line; and the trajectory."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    file = tmp_path_factory.mktemp("rerun") / "motion.rrd"
    shown = skills.few_bottles()
    situation = Situation(shown[1].joints[0], shown[1].frames)
    objects = {"bottle": parse_shape("cylinder:0.05,0.2")}
    trajectory = write_rerun(file, with_an_event(), situation, shown, objects=objects, fps=2)
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    found: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(file).stream():
        table = chunk.to_record_batch().to_pydict()
        for name, values in table.items():
            if "time" in table and ":" in name:
                found[chunk.entity_path][name] += zip(table["time"], values, strict=True)
            elif ":" in name:
                found[chunk.entity_path][f"static {name}"] += values
    return found, trajectory


def test_links_are_where_the_joints_put_them(chunks):
    found, trajectory = chunks
    moved = found["/robot/l_hand"]
    hand = upper_body().state(trajectory.joints).position("l_hand")
    instants = (trajectory.time - trajectory.time[0]).numpy()
    assert len(moved["Transform3D:translation"]) > 20
    for now, [position] in moved["Transform3D:translation"]:
        step = int(np.abs(instants - now.total_seconds()).argmin())
        np.testing.assert_allclose(position, hand[step], atol=2e-5)


def test_events_are_logged_when_they_are(chunks):
    found, trajectory = chunks
    expected = [(m.time, m.label) for m in motion_marks(with_an_event(), trajectory)]
    logged = [
        (pytest.approx(now.total_seconds(), abs=1e-6), text)
        for now, [text] in found["/marks"]["TextLog:text"]
    ]
    assert [label for _, label in expected] == ["grasp"]
    assert expected == logged


def test_paths_objects_uncertainty_and_curves_are_those_of_the_page(chunks):
    found, trajectory = chunks
    assert len(found["/reproduction/l_hand"]["static LineStrips3D:strips"][0]) >= 200
    assert found["/frames/bottle/shape"]["static Cylinders3D:lengths"] == [[pytest.approx(0.2)]]
    assert found["/covariance/r_hand"]["static Ellipsoids3D:half_sizes"]
    assert found["/demonstrations/l_hand"]
    *_, shares = motion_panels(skills.small_bottle(), trajectory)
    [entity] = [name for name in found if re.fullmatch("/curves/.*/joints", name)]
    values = [value for _, [value] in found[entity]["Scalars:scalars"]]
    np.testing.assert_allclose(values, shares.curves[-1].values, rtol=1e-6)

"""What a data set tells: a policy that is to be trained, and ``tpgmm fit``."""

import json

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig, state_features
from lerobot_policy_tpgmm.dataset_contract import adopt
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support import planted_poses as planted
from tests.support.lerobot_metadata import dataset
from tests.support.policies import ENVIRONMENT, STATE, fitted
from tpgmm_datasets.robots import parse_robot, upper_body_urdf
from tpgmm_datasets.units import Scale
from tpgmm_torch import Canonical, Robot
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import JointSpace

NAMES = fitted().kinematics.joint_names
POSE = [f"bottle.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
JOINTS = {"operators": ["canonical"]}
UPPER_BODY = {"robot": "upper_body", "links": ["l_hand", "r_hand"]}


def config(n_environment: int = 7, **options: object) -> TPGMMConfig:
    """As ``make_policy`` gives it to a policy."""
    made = TPGMMConfig(device="cpu", **state_features(17, n_environment, 17), **options)
    made.input_features["observation.image"] = PolicyFeature(FeatureType.VISUAL, (3, 8, 8))
    return made


def environment(names):
    return {ENVIRONMENT: {"dtype": "float32", "shape": (7,), "names": names}}


def test_a_data_set_completes_a_configuration():
    made = config(**UPPER_BODY)
    kinematics, operators = adopt(made, dataset(20, **environment(POSE)))
    assert made.fps == made.rate == 20
    assert made.state_names == made.action_names == list(NAMES)
    assert made.environment_names == POSE and not made.units
    assert set(made.input_features) == {STATE, ENVIRONMENT}
    assert kinematics == fitted().kinematics
    assert tuple(operators) == fitted().to_estimator().operators_


def test_what_is_given_stays():
    given = {"operators": ["position:l_hand@cup"], "frames": {"cup": [*range(7)]}}
    made = config(**UPPER_BODY, **given, units="deg", control_fps=50.0)
    policy = TPGMMPolicy(made, dataset_meta=dataset(20))
    assert made.operators == given["operators"] and made.units == "deg" and made.rate == 50
    assert policy.frames.in_environment == given["frames"]


def test_units_that_the_data_set_declares_are_taken():
    units = ["deg"] * 16 + ["mm"]
    feature = {"shape": (17,), "names": list(NAMES), "info": {"units": units}}
    made = config(**UPPER_BODY)
    data = dataset(20, **{STATE: feature}, **environment(POSE))
    policy = TPGMMPolicy(made, dataset_meta=data)
    joints = policy.joints.joints(torch.full((1, 17), 180.0))
    np.testing.assert_allclose(joints[0], [np.pi] * 16 + [0.18])


def test_joints_alone_need_no_robot():
    made = config(n_environment=0)
    kinematics, operators = adopt(made, dataset(20))
    assert kinematics == JointSpace(NAMES)
    assert operators == [Canonical()]


@pytest.mark.parametrize(
    ("options", "features", "message"),
    [
        (UPPER_BODY, environment(None), r"tell of no pose: name the frames, --policy.frames="),
        ({"fps": 50.0}, {}, "20 steps per second, the policy was made for 50: resample it"),
        (JOINTS | {"state_names": ["a", "b"]}, {}, r"state_names are \['a', 'b'\], 2 entries"),
        ({"robot": "no.urdf", "links": ["hand"]}, {}, "no.urdf"),
    ],
)
def test_what_does_not_fit_a_data_set_is_refused(options, features, message):
    made = config(**options)
    with pytest.raises((DataError, OSError), match=message):
        TPGMMPolicy(made, dataset_meta=dataset(20, **features))


@pytest.mark.parametrize("robot", [None, {"robot": "{folder}/body.urdf"}])
def test_objects_are_forgotten_only_if_that_is_asked_for(robot, tmp_path):
    (tmp_path / "body.urdf").write_text(upper_body_urdf().replace("_hand", "_end"))
    given = {key: text.format(folder=tmp_path) for key, text in (robot or {}).items()}
    for names in (POSE, None):
        data = dataset(20, **environment(names))
        with pytest.raises(DataError, match=r"\['(bottle|observation.environment_state)'\] wo"):
            adopt(config(**given), data)
        assert adopt(config(**given, **JOINTS), data)[1] == [Canonical()]
    with pytest.raises(DataError, match=r"--link \(--policy.links\) of .*'l_end'"):
        adopt(config(robot=str(tmp_path / "body.urdf")), dataset(20, **environment(POSE)))


def test_several_robots_are_one_text():
    text = "left=so101@0,0.2,0;right=so101@0,-0.2,0"
    for given in (text, "bi_so101"):
        made = draccus.parse(TPGMMConfig, args=[f"--robot={given}", "--device=cpu"])
        assert made.robot == given and made.kinematics() == parse_robot("bi_so101")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (None, r"does not name the values of observation.state, .*--policy.state_names="),
        ([*NAMES[:16], NAMES[0]], r"'\w+' is there twice.*--policy.state_names="),
        (list(NAMES[:16]), r"16 names for 17 values.*--policy.state_names="),
    ],
)
def test_values_of_a_robot_are_named_by_somebody(names, message):
    state = {STATE: {"dtype": "float32", "shape": (17,), "names": names}}
    with pytest.raises(DataError, match=message):
        adopt(config(**UPPER_BODY), dataset(20, **environment(POSE), **state))
    said = config(**UPPER_BODY, state_names=list(NAMES[::-1]))
    adopt(said, dataset(20, **environment(POSE), **state))
    assert said.state_names == list(NAMES[::-1])


@pytest.mark.parametrize("joints", ["l_*, waist_yaw", ["l_*", "waist_yaw"], "l_*,waist_yaw"])
def test_joints_are_chosen_by_patterns(joints):
    given = ["--robot=upper_body", f"--joints={joints}", "--device=cpu", "--links=[l_hand]"]
    made = draccus.parse(TPGMMConfig, args=given)
    every = Robot.from_urdf(upper_body_urdf(), []).joint_names
    chosen = [*(name for name in every if name.startswith("l_")), "waist_yaw"]
    assert list(made.kinematics().joint_names) == chosen
    again = draccus.decode(TPGMMConfig, draccus.encode(made))
    assert again.joints == made.joints


def test_units_may_be_the_calibration_of_the_robot(tmp_path):
    motors = {name: {"drive_mode": 0, "range_min": 0, "range_max": 2048} for name in NAMES[:3]}
    (tmp_path / "arm.json").write_text(json.dumps(motors))
    made = config(**UPPER_BODY, units=str(tmp_path / "arm.json"))
    adopt(made, dataset(20, **environment(POSE)))
    scale = Scale.from_calibration(0, 2048)
    assert made.units == {name: [scale.factor, scale.offset] for name in NAMES[:3]}


def make_tracked_set(path, **cell):
    """A data set in which tracking has left its cell, and offsets of joints."""
    cell = {"cameras": planted.cell_content()["cameras"], **cell}
    (path / "meta").mkdir()
    (path / "meta" / "cell.json").write_text(json.dumps(cell))
    feature = {"dtype": "float32", "shape": (17,), "names": list(NAMES)}
    feature["info"] = {"offsets": [0.02, *[0.0] * 16]}
    made = dataset(20, **environment(POSE), **{STATE: feature, "action": feature})
    made.root = path
    return made, cell


def test_the_cell_of_a_tracked_set_goes_along(tmp_path):
    bottle = {"bottle": {"target": {"tag": 3, "size": 0.06}}}
    meta, cell = make_tracked_set(tmp_path, objects=bottle, joint_offsets={NAMES[0]: 0.02})
    made = config(**UPPER_BODY)
    policy = TPGMMPolicy(made, dataset_meta=meta)
    assert made.cell == cell and policy.watch is not None
    # of the set's pictures those that the cell looks at
    assert set(made.input_features) == {STATE, ENVIRONMENT, planted.KEY}
    joints = policy.joints.joints(torch.zeros(1, 17))[0]
    assert float(joints[0]) == 0.02 and not joints[1:].any()
    blind = config(**UPPER_BODY, cell="none")
    assert TPGMMPolicy(blind, dataset_meta=meta).watch is None
    assert blind.cell == cell | {"source": "none"}
    assert set(blind.input_features) == {STATE, ENVIRONMENT}


def test_a_set_is_learned_with_its_own_offsets_and_run_with_those_of_its_cell(tmp_path, caplog):
    bottle = {"bottle": {"target": {"tag": 3, "size": 0.06}}}
    meta, cell = make_tracked_set(tmp_path, objects=bottle, joint_offsets={NAMES[0]: 0.02})
    other = cell | {"joint_offsets": {NAMES[0]: 0.05}}
    policy = TPGMMPolicy(config(**UPPER_BODY, cell=other), dataset_meta=meta)
    assert float(policy.joints.joints(torch.zeros(1, 17))[0, 0]) == 0.02
    assert "is offset by +1.72 deg more" in caplog.text
    assert policy.config.cell == other

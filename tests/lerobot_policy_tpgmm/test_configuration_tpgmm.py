"""What ``config.json`` holds: defaults, overrides, and values that are refused."""

import copy
import inspect
from dataclasses import fields

import draccus
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy

from lerobot_policy_tpgmm.configuration_tpgmm import TPGMMConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from lerobot_policy_tpgmm.settings import FusionConfig
from tests.support.policies import grouped, loaded
from tests.support.skills import small_bottle
from tpgmm_torch import Hold, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion

HANDED_OVER = [Hold("bottle", "l_hand", 4.3, 5.0), Hold("bottle", "r_hand", 5.0)]


def test_defaults_of_the_estimator_are_those_of_the_configuration():
    parameters = inspect.signature(TaskParameterizedGMM).parameters
    config = TPGMMConfig(device="cpu")
    others = {"n_components", "operators", "robot", "fusion", "device"}
    assert vars(config.em).keys() == parameters.keys() - others
    for name, value in vars(config.em).items():
        assert value == parameters[name].default
    assert config.fusion.value() == InformationFusion()
    assert FusionConfig(form="covariance").value() == CovarianceFusion()
    for fusion in (CovarianceFusion(1e-3, "product"), InformationFusion(5.0, [1, 0])):
        assert FusionConfig.from_fusion(fusion).value() == fusion


def test_fields_can_be_overridden(saved):
    policy = loaded(
        saved,
        "--control_fps=50",
        "--units=deg",
        "--default_environment_state=[0, 0, 0, 1, 0, 0, 0]",
        "--control.largest_start_gap=null",
        '--frames={"bottle": [0, 1, 2, 3, 4, 5, 6]}',
        "--control.feedback=observation",
        env_cfg=make_env_config("bottle_shaking"),
    )
    assert policy.config.rate == 50 and policy.config.control.largest_start_gap is None
    assert policy.config.units == "deg" and policy.config.control.feedback == "observation"
    assert policy.frames.default.tolist() == [0, 0, 0, 1, 0, 0, 0]


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ('--holds=["bottle@l_hand:4.3-5.2"]', [Hold("bottle", "l_hand", 4.3, 5.2)]),
        ('--holds=["bottle@l_hand:4.3-5","bottle@r_hand:5-"]', HANDED_OVER),
        ("--holds=[]", []),
        ("--control.clock=localizing", []),  # as it was saved
    ],
)
def test_holds_can_be_overridden(saved, override, wanted):
    policy = loaded(saved, override, env_cfg=make_env_config("bottle_shaking"))
    assert policy.to_estimator().holds_ == tuple(wanted)


def test_what_a_model_holds_and_how_it_moves_goes_along(tmp_path):
    model = copy.copy(small_bottle())
    model.holds_ = tuple(HANDED_OVER)
    policy = TPGMMPolicy.from_estimator(model)
    policy.save_pretrained(tmp_path)
    again = TPGMMPolicy.from_pretrained(tmp_path)
    assert again.config == policy.config
    back = again.to_estimator()
    assert back.holds_ == model.holds_
    for bound in fields(bounds := model.skill.motion_bounds):
        one, other = (getattr(b, bound.name) for b in (bounds, back.skill.motion_bounds))
        assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("clock", "sundial"),
        ("joint_timeout", 0.0),
        ("feedback", "velocity"),
        ("alignment", "guess"),
        ("form", "sum"),
        ("n_components", 0),
        ("control_fps", 0.0),
        ("fps", float("nan")),
        ("chunk_size", 0),
        ("dtype", "bfloat16"),
        ("normalization_mapping", {"STATE": NormalizationMode.MEAN_STD}),
    ],
)
def test_a_value_that_is_none_is_refused(field, value):
    with pytest.raises((ValueError, TypeError), match=field):
        TPGMMConfig(device="cpu", **grouped(**{field: value}))


def test_what_lerobots_parser_drops_is_told_before(caplog):
    with pytest.raises(ParsingError):
        draccus.parse(TPGMMConfig, args=["--control.clock=foo"])
    assert "one of ['localizing', 'waiting', 'even'], got 'foo'" in caplog.text


def test_a_policy_without_anything_to_learn_from_is_refused():
    config = TPGMMConfig(device="cpu")
    with pytest.raises(DataError, match=r"--dataset.root"):
        make_policy(config, env_cfg=make_env_config("bottle_shaking"))
    config.input_features = {"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 8, 8))}
    with pytest.raises(DataError, match=r"needs observation.state; there are \['action'"):
        config.validate_features()
    with pytest.raises(DataError, match="does not know its rate"):
        _ = config.rate

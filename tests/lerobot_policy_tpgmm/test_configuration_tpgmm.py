"""What ``config.json`` holds: defaults, overrides, and values that are refused."""

import copy
import inspect

import draccus
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy

from lerobot_policy_tpgmm.configuration_tpgmm import HYPERPARAMETERS, TPGMMConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.policies import loaded
from tests.support.skills import small_bottle
from tpgmm_torch import Hold, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError

HANDED_OVER = [Hold("bottle", "l_hand", 4.3, 5.0), Hold("bottle", "r_hand", 5.0)]


def test_what_the_estimator_defaults_to_is_the_default():
    parameters = inspect.signature(TaskParameterizedGMM).parameters
    config = TPGMMConfig(device="cpu")
    left_out = {"operators", "parts", "robot", "holds", "warm_start", "device", "verbose"}
    assert set(HYPERPARAMETERS) == set(parameters) - left_out
    for name in HYPERPARAMETERS:
        assert getattr(config, name) == parameters[name].default
    assert config.holds is None and config.estimator(None, ()).holds == "auto"
    assert TPGMMConfig(holds=[]).estimator(None, ()).holds == []
    assert config.parts is None and config.estimator(None, ()).parts is None


def test_every_field_is_explained():
    for name in vars(TPGMMConfig(device="cpu")).keys() - vars(PreTrainedConfig).keys():
        if name not in PreTrainedConfig.__dataclass_fields__:
            assert name in TPGMMConfig.__doc__ or name == "normalization_mapping", name


def test_fields_can_be_overridden(saved):
    policy = loaded(
        saved,
        "--control_fps=50",
        "--units=deg",
        "--default_environment_state=[0, 0, 0, 1, 0, 0, 0]",
        "--largest_start_gap=null",
        '--frames={"bottle": [0, 1, 2, 3, 4, 5, 6]}',
        "--feedback=observation",
        env_cfg=make_env_config("bottle_shaking"),
    )
    assert policy.config.rate == 50 and policy.config.largest_start_gap is None
    assert policy.config.units == "deg" and policy.config.feedback == "observation"
    assert policy.frames.default.tolist() == [0, 0, 0, 1, 0, 0, 0]


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ('--holds=["bottle@l_hand:4.3-5.2"]', [Hold("bottle", "l_hand", 4.3, 5.2)]),
        ('--holds=["bottle@l_hand:4.3-5","bottle@r_hand:5-"]', HANDED_OVER),
        ("--holds=[]", []),
        ("--clock=localizing", []),  # as it was saved
    ],
)
def test_holds_can_be_overridden(saved, override, wanted):
    policy = loaded(saved, override, env_cfg=make_env_config("bottle_shaking"))
    assert policy.to_estimator().holds_ == tuple(wanted)


@pytest.mark.parametrize(
    ("override", "wanted"),
    [("--parts=auto", "auto"), ("--parts=2.5", [2.5]), ("--parts=2.5,close", [2.5, "close"])],
)
def test_parts_can_be_told(saved, override, wanted):
    config = PreTrainedConfig.from_pretrained(saved, cli_overrides=[override])
    assert config.estimator(None, ()).parts == wanted


def test_what_a_model_holds_and_how_it_moves_goes_along(tmp_path):
    model = copy.copy(small_bottle())
    model.holds_ = tuple(HANDED_OVER)
    policy = TPGMMPolicy.from_estimator(model)
    policy.save_pretrained(tmp_path)
    again = TPGMMPolicy.from_pretrained(tmp_path)
    assert again.config == policy.config
    back = again.to_estimator()
    assert back.holds_ == model.holds_
    assert torch.equal(back.acceleration_, model.acceleration_)
    assert torch.equal(back.jerk_, model.jerk_)
    for name, bound in vars(model.skill.motion_bounds).items():
        assert torch.equal(getattr(back.skill.motion_bounds, name), bound)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("clock", "sundial"),
        ("patience", 0.0),
        ("feedback", "velocity"),
        ("loss", "hinge"),
        ("alignment", "guess"),
        ("fusion", "sum"),
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
        TPGMMConfig(device="cpu", **{field: value})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"holds": ["bottle"]}, "not of the form FRAME@LINK:BEGIN-END"),
        ({"smoothing": -1.0}, "cutoff of OneEuro is positive"),
    ],
)
def test_a_setting_of_the_controller_that_cannot_be_is_refused(options, message):
    with pytest.raises(DataError, match=message):
        TPGMMConfig(device="cpu", **options)


def test_what_lerobots_parser_drops_is_told_before(caplog):
    with pytest.raises(ParsingError):
        draccus.parse(TPGMMConfig, args=["--clock=foo"])
    assert "clock 'foo': there is no 'foo'; there are ['even', 'waiting'" in caplog.text


def test_a_policy_without_anything_to_learn_from_is_refused():
    config = TPGMMConfig(device="cpu")
    with pytest.raises(DataError, match=r"--dataset.root"):
        make_policy(config, env_cfg=make_env_config("bottle_shaking"))
    config.input_features = {"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 8, 8))}
    with pytest.raises(DataError, match=r"needs observation.state; there are \['action'"):
        config.validate_features()
    with pytest.raises(DataError, match="does not know its rate"):
        _ = config.rate

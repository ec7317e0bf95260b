"""The pretrained directory: complete, read strictly, and refused where it does not belong."""

import copy
import inspect
import json
import logging
import shutil

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy, make_pre_post_processors
from safetensors.torch import load_file, save_file

import lerobot_policy_tpgmm
from lerobot_policy_tpgmm.configuration_tpgmm import HYPERPARAMETERS, TPGMMConfig
from lerobot_policy_tpgmm.control_rate import CONTROL_RATE, rate_processors
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.lerobot_metadata import dataset
from tests.support.policies import STATE, act, batch, changed, fitted
from tests.support.skills import bottle_model, canonical, small_bottle, waves
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Canonical, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, ModelFileError, NotFittedError, ShapeError

FILES = {
    "config.json",
    "model.safetensors",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
}
DEVICE = {
    "device_processor": {"device": "cpu"},
    "rename_observations_processor": {"rename_map": {}},
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Not to be changed."""
    path = tmp_path_factory.mktemp("policy") / "saved"
    fitted().save_pretrained(path)
    return path


@pytest.fixture
def directory(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "policy")


def loaded(path, *overrides: str, **more):
    """As LeRobot's commands load a policy."""
    config = PreTrainedConfig.from_pretrained(path, cli_overrides=list(overrides))
    config.pretrained_path = path
    return make_policy(config, **more)


# What is there


def test_the_directory_is_complete(saved):
    assert {path.name for path in saved.iterdir()} == FILES
    config = json.loads((saved / "config.json").read_text())
    assert config["robot"]["config"]["urdf"] == upper_body_urdf()
    assert config["operators"][1] == "canonical"
    with pytest.raises(ModelFileError):  # it is no model of the estimator's own format
        TaskParameterizedGMM.load(saved)


def test_a_policy_comes_back_equal(saved):
    wanted = act(fitted(), batch(), 20)
    direct = TPGMMPolicy.from_pretrained(saved)
    assert direct.config == fitted().config and not direct.training
    assert torch.equal(act(direct, batch(), 20), wanted)
    made = loaded(saved, env_cfg=make_env_config("bottle_shaking"))
    assert isinstance(made, TPGMMPolicy)
    assert torch.equal(act(made, batch(), 20), wanted)


def test_saving_twice_replaces(directory):
    other = changed(fitted(), chunk_size=3)
    other.save_pretrained(directory)
    assert {path.name for path in directory.iterdir()} == FILES
    assert TPGMMPolicy.from_pretrained(directory).config.chunk_size == 3


def test_the_pipelines_around_it_change_nothing(saved):
    pipelines = make_pre_post_processors(
        fitted().config, pretrained_path=str(saved), preprocessor_overrides=DEVICE
    )
    before, after = pipelines
    observed = {**batch(), "task": ["shake"] * 2}
    with torch.inference_mode():
        fitted().reset()
        through = after(fitted().select_action(before(observed)))
    assert torch.equal(through, act(fitted(), batch(), 1)[:, 0])
    assert torch.equal(before(observed)[STATE], batch()[STATE])


def test_the_model_can_be_taken_out_again():
    model = fitted().to_estimator()
    torch.testing.assert_close(model.means_, small_bottle().means_)
    torch.testing.assert_close(model.weights_, small_bottle().weights_)
    assert model.operators_ == small_bottle().operators_


# What is refused at load


def rewritten(path, change):
    tensors = load_file(path / "model.safetensors")
    change(tensors)
    save_file(tensors, path / "model.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.pop("mixture.logits"),
            r"mixture.logits is missing, expected float64 \(8,\)",
        ),
        (lambda t: t.update(more=torch.zeros(2)), r"more is float32 \(2,\), expected nothing"),
        (
            lambda t: t.update({"mixture.time": torch.zeros(3)}),
            r"mixture.time is float32 \(3,\)",
        ),
        (lambda t: t["mixture.fitted"].fill_(False), "saved before it was fitted"),
        (lambda t: t["mixture.means.0"].fill_(torch.nan), "hold NaN or infinity"),
    ],
    ids=["missing", "extra", "wrong size", "unfitted", "not finite"],
)
def test_numbers_that_do_not_belong_are_refused(directory, change, message):
    rewritten(directory, change)
    for load in (TPGMMPolicy.from_pretrained, loaded_alone):
        with pytest.raises((ModelFileError, DataError), match=message):
            load(directory)


def loaded_alone(path):
    return loaded(path, env_cfg=make_env_config("bottle_shaking"))


@pytest.mark.parametrize("keep", [0, 100, 1000])
def test_a_truncated_file_is_refused(directory, keep):
    file = directory / "model.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ModelFileError, match="cannot be read"):
        TPGMMPolicy.from_pretrained(directory)
    file.unlink()
    with pytest.raises(ModelFileError, match="cannot be read"):
        TPGMMPolicy.from_pretrained(directory)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("n_components", 9, r"mixture.logits is float64 \(8,\), expected float64 \(9,\)"),
        ("n_steps", 5, r"mixture.time is .* expected float64 \(5,\)"),
        ("dtype", "float32", r"expected float32"),
        ("operators", ["canonical"], "mixture.factors.1 is .*, expected nothing"),
        ("operators", ["shake"], "'shake' is not a term"),
        ("operators", ["position:foot"], "link 'foot' is not in"),
        ("robot", {"type": "Robot", "config": {}}, "cannot be rebuilt"),
        ("robot", {"type": "Spot", "config": {}}, "'Spot', which is not known here"),
        ("robot", None, "not fitted needs a data set"),
    ],
)
def test_a_configuration_of_something_else_is_refused(directory, field, value, message):
    path = directory / "config.json"
    config = json.loads(path.read_text()) | {field: value}
    path.write_text(json.dumps(config))
    with pytest.raises((ModelFileError, DataError, KeyError), match=message):
        TPGMMPolicy.from_pretrained(directory)


# What is refused because robot, environment or data set are others


def test_an_environment_of_other_actions_is_refused(saved):
    with pytest.raises(ShapeError, match=r"17 entries, but the environment .* shape \(14,\)"):
        loaded(saved, env_cfg=make_env_config("aloha_state"))


def test_an_environment_of_another_rate_is_refused():
    told, _ = rate_processors(50)
    observed = told(batch())
    assert observed[CONTROL_RATE].tolist() == [[50.0], [50.0]]
    with pytest.raises(DataError, match=r"takes 50 actions per second, the policy gives 2.\d+"):
        act(fitted(), observed, 1)
    same = changed(fitted(), control_fps=50.0)
    assert torch.equal(act(same, observed, 3), act(same, batch(), 3))
    telling = make_env_config("bottle_shaking", fps=25).get_env_processors()[0]
    assert telling(batch())[CONTROL_RATE][0, 0] == 25


def test_the_data_set_of_the_fit_is_accepted(saved):
    assert loaded(saved, ds_meta=dataset()).config.n_steps == len(small_bottle().time_)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"fps": 50},
            r"has 50 steps per second, the policy was made for 2\.\d+: resample.*--rate 2",
        ),
        ({"names": fitted().kinematics.joint_names[::-1]}, r"--policy.state_names='\[...\]'"),
        ({"names": ("a", "b", "c")}, r"entries \['a', 'b', 'c'\], the policy was made for"),
        (
            {"action": {"dtype": "float32", "shape": (14,), "names": None}},
            r"17 entries, but the environment or data set has a feature of shape \(14,\)",
        ),
    ],
    ids=["rate", "order", "joints", "size"],
)
def test_another_data_set_is_refused(saved, given, message):
    with pytest.raises(DataError, match=message):
        loaded(saved, ds_meta=dataset(**given))


# Configurations


def test_what_the_estimator_defaults_to_is_the_default():
    parameters = inspect.signature(TaskParameterizedGMM).parameters
    config = TPGMMConfig(device="cpu")
    left_out = {"operators", "robot", "warm_start", "device", "verbose"}
    assert set(HYPERPARAMETERS) == set(parameters) - left_out
    for name in HYPERPARAMETERS:
        assert getattr(config, name) == parameters[name].default


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
    ("field", "value"),
    [
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


def test_a_policy_without_anything_to_learn_from_is_refused():
    config = TPGMMConfig(device="cpu")
    with pytest.raises(DataError, match=r"--dataset.root"):
        make_policy(config, env_cfg=make_env_config("bottle_shaking"))
    config.input_features = {"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 8, 8))}
    with pytest.raises(DataError, match=r"needs observation.state; there are \['action'"):
        config.validate_features()
    with pytest.raises(DataError, match="does not know its rate"):
        _ = config.rate


# Estimators


class Mine(Canonical):
    """An operator of one's own."""


def test_estimators_that_cannot_be_written_are_refused():
    with pytest.raises(NotFittedError, match="call fit"):
        TPGMMPolicy.from_estimator(bottle_model())
    model = canonical(operators=[Mine()]).fit(waves())
    with pytest.raises(ModelFileError, match="'Mine', which is not known here"):
        TPGMMPolicy.from_estimator(model)


def test_a_seed_that_is_no_number_is_left_out(caplog):
    model = copy.copy(canonical().fit(waves())).set_params(
        random_state=np.random.RandomState(0)
    )
    with caplog.at_level(logging.WARNING):
        policy = TPGMMPolicy.from_estimator(model, chunk_size=4)
    assert policy.config.random_state is None and policy.config.chunk_size == 4
    assert not caplog.records
    assert lerobot_policy_tpgmm.TPGMMConfig is type(policy.config)

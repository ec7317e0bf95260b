"""The pretrained directory: complete, read strictly, and refused where it does not belong."""

import json
import os
import shutil

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_policy_tpgmm import policy_files
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.lerobot_metadata import dataset
from tests.support.policies import STATE, act, batch, changed, fitted, loaded
from tests.support.skills import small_bottle
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch.exceptions import DataError, ModelFileError, ShapeError
from tpgmm_torch.persistence import load_model

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


@pytest.fixture
def directory(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "policy")


# What is there


def test_the_directory_is_complete(saved):
    assert {path.name for path in saved.iterdir()} == FILES
    config = json.loads((saved / "config.json").read_text())
    assert config["robot"]["config"]["urdf"] == upper_body_urdf()
    assert config["operators"][1] == "canonical"
    with pytest.raises(ModelFileError):  # it is no model of the estimator's own format
        load_model(saved)


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


def test_an_interrupted_save_leaves_what_was_there(directory, monkeypatch):
    (directory / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    other = changed(fitted(), chunk_size=3)
    with torch.no_grad():
        other.mixture.logits.zero_()

    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:  # when settings and numbers are written
        patch.setattr(policy_files, "make_tpgmm_pre_post_processors", stop)
        with pytest.raises(KeyboardInterrupt):
            other.save_pretrained(directory)
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before
    assert [path.name for path in directory.parent.iterdir()] == [directory.name]
    other.save_pretrained(directory)
    assert TPGMMPolicy.from_pretrained(directory).config.chunk_size == 3
    assert (directory / "notes.txt").read_text() == "mine"


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
    with pytest.raises(ModelFileError, match=r"cannot be read|truncated"):
        TPGMMPolicy.from_pretrained(directory)
    file.unlink()
    with pytest.raises(ModelFileError, match="cannot be read"):
        TPGMMPolicy.from_pretrained(directory)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("n_components", 9, r"mixture.logits is float64 \(8,\), expected float64 \(9,\)"),
        ("fit.n_steps", 5, r"mixture.time is .* expected float64 \(5,\)"),
        ("em.dtype", "float32", r"expected float32"),
        ("operators", ["canonical"], "mixture.factors.1 is .*, expected nothing"),
        ("operators", ["shake"], "'shake' is not a term"),
        ("operators", ["auto"], "tpgmm fit --operator auto"),
        ("operators", ["position:foot"], "link 'foot' is not in"),
        ("robot", {"type": "Robot", "config": {}}, "cannot be rebuilt"),
        ("robot", {"type": "Spot", "config": {}}, "'Spot', which is not known here"),
        ("robot", None, "not fitted needs a data set"),
    ],
)
def test_a_configuration_of_something_else_is_refused(directory, field, value, message):
    config = PreTrainedConfig.from_pretrained(directory)
    group, _, name = field.rpartition(".")
    setattr(getattr(config, group) if group else config, name, value)
    with pytest.raises((ModelFileError, DataError, KeyError), match=message):
        TPGMMPolicy.from_pretrained(directory, config=config)


# What is of two saves


def replaced_text(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize("name", sorted(FILES - {"policy_postprocessor.json"}))
def test_a_file_of_another_save_is_refused(directory, tmp_path, name):
    other = changed(fitted(), chunk_size=3)
    with torch.no_grad():
        other.mixture.logits.add_(0.1 * torch.randn(8, dtype=torch.float64))
    other.save_pretrained(tmp_path / "other")
    replaced_text(tmp_path / "other" / "policy_preprocessor.json", "IDENTITY", "MEAN_STD")
    shutil.copy(tmp_path / "other" / name, directory / name)
    message = {"policy_preprocessor.json": name}.get(name, r"config.json is not what was saved")
    with pytest.raises(ModelFileError, match=message):
        TPGMMPolicy.from_pretrained(directory)
    with pytest.raises(ModelFileError, match=message):
        loaded_alone(directory)


def test_what_lerobot_train_writes_again_is_accepted(directory):
    # its own device and names, and statistics that nothing is normalised with
    path = directory / "policy_preprocessor.json"
    replaced_text(path, '"rename_map": {}', '"rename_map": {"observation.images.a": "b"}')
    replaced_text(path, '"device": "cpu"', '"device": "cuda"')
    content = json.loads(path.read_text())
    content["steps"][-1]["state_file"] = "policy_preprocessor_step_3.safetensors"
    path.write_text(json.dumps(content))
    (directory / "train_config.json").write_text("{}")
    assert TPGMMPolicy.from_pretrained(directory).config == fitted().config


def test_a_policy_of_an_earlier_version_says_to_fit_again(directory):
    rewritten(directory, lambda tensors: None)  # whatever its digests say
    config = json.loads((directory / "config.json").read_text())
    earlier = {name: value for name, value in config.items() if name not in ("em", "control")}
    earlier |= {"fusion": "information", "clock": "even", "operator_weights": "equal"}
    (directory / "config.json").write_text(json.dumps(earlier))
    with pytest.raises(ModelFileError, match="fit again"):
        TPGMMPolicy.from_pretrained(directory)


def test_a_policy_without_digests_loads_and_says_so(directory, caplog):
    rewritten(directory, lambda tensors: None)
    assert TPGMMPolicy.from_pretrained(directory).config == fitted().config
    assert "saved without digests" in caplog.text


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.json", "[" * 100_000, "config.json"),
        ("policy_preprocessor.json", "[" * 100_000, "policy_preprocessor.json cannot be read"),
        ("policy_postprocessor.json", '{"steps": [3]}', "postprocessor.json cannot be read"),
    ],
)
def test_json_that_cannot_be_read_is_refused(directory, name, content, message):
    (directory / name).write_text(content)
    with pytest.raises(ModelFileError, match=message):
        TPGMMPolicy.from_pretrained(directory)


@pytest.mark.parametrize("name", sorted(FILES))
def test_a_pipe_is_refused_at_once(directory, name):
    (directory / name).unlink()
    os.mkfifo(directory / name)
    with pytest.raises(ModelFileError, match=rf"{name}.*not a regular file"):
        TPGMMPolicy.from_pretrained(directory)


def test_a_folder_that_is_not_there_is_not_looked_up_on_the_hub(tmp_path):
    with pytest.raises(ModelFileError, match=r"there is no folder .*polciy"):
        TPGMMPolicy.from_pretrained(tmp_path / "polciy")


def test_the_old_one_is_found_again_where_a_save_died_between_two_renames(directory):
    directory.rename(directory.with_name(".policy.abcdefgh.previous"))
    assert TPGMMPolicy.from_pretrained(directory).config == fitted().config


# What is refused because robot, environment or data set are others


def test_an_environment_of_other_actions_is_refused(saved):
    with pytest.raises(ShapeError, match=r"17 entries, but the environment .* shape \(14,\)"):
        loaded(saved, env_cfg=make_env_config("aloha_state"))


def test_the_data_set_of_the_fit_is_accepted(saved):
    assert loaded(saved, ds_meta=dataset()).config.fit.n_steps == len(small_bottle().time_)


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

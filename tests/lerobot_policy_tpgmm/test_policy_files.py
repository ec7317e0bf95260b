"""The pretrained directory: complete, read strictly, and refused where it does not belong."""

import hashlib
import json
import logging
import os
import shutil

import pytest
import torch
from draccus.utils import DecodingError
from lerobot.configs import PreTrainedConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_tpgmm import policy_files
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.lerobot_metadata import dataset
from tests.support.policies import STATE, act, batch, changed, fitted, loaded
from tests.support.skills import same, small_bottle
from tpgmm_torch.exceptions import DataError, ModelFileError, ShapeError
from tpgmm_torch.persistence import load

FILES = {"config.json", "digests.json", "model/config.json", "model/model.safetensors"}
FILES |= {"policy_preprocessor.json", "policy_postprocessor.json"}
OTHER = {"dtype": "float32", "shape": (14,), "names": None}
DEVICE = {
    "device_processor": {"device": "cpu"},
    "rename_observations_processor": {"rename_map": {}},
}


def files_of(folder):
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


@pytest.fixture
def directory(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "policy")


# What is there


def test_the_directory_contains_a_model_in_its_own_format(saved):
    assert files_of(saved).keys() == FILES
    for place in (saved, saved / "model"):
        same(model := load(place), small_bottle(), 0)
    assert model.kinematics_ == small_bottle().kinematics_
    with pytest.raises(ModelFileError, match=r"a model, not a policy: tpgmm_torch\.load"):
        TPGMMPolicy.from_pretrained(saved / "model")


def test_a_policy_comes_back_equal(saved):
    wanted = act(fitted(), batch(), 20)
    direct = TPGMMPolicy.from_pretrained(saved)
    assert direct.config == fitted().config and not direct.training
    assert torch.equal(act(direct, batch(), 20), wanted)
    made = loaded(saved, env_cfg=make_env_config("bottle_shaking"))
    assert isinstance(made, TPGMMPolicy)
    assert torch.equal(act(made, batch(), 20), wanted)


def test_an_interrupted_save_leaves_what_was_there(directory, monkeypatch):
    (directory / "notes.txt").write_text("mine")
    before, other = files_of(directory), changed(fitted(), chunk_size=3)

    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:  # when settings and numbers are written
        patch.setattr(policy_files, "make_tpgmm_pre_post_processors", stop)
        with pytest.raises(KeyboardInterrupt):
            other.save_pretrained(directory)
    assert files_of(directory) == before
    assert [path.name for path in directory.parent.iterdir()] == [directory.name]
    other.save_pretrained(directory)
    assert TPGMMPolicy.from_pretrained(directory).config.chunk_size == 3
    assert (directory / "notes.txt").read_text() == "mine"


def test_the_pipelines_around_it_change_nothing(saved):
    given = {"pretrained_path": str(saved), "preprocessor_overrides": DEVICE}
    before, after = make_pre_post_processors(fitted().config, **given)
    observed = {**batch(), "task": ["shake"] * 2}
    with torch.inference_mode():
        fitted().reset()
        through = after(fitted().select_action(before(observed)))
    assert torch.equal(through, act(fitted(), batch(), 1)[:, 0])
    assert torch.equal(before(observed)[STATE], batch()[STATE])


def test_a_policy_of_release_0_3_with_options_of_gradient_steps_runs(directory, caplog):
    file, digests = directory / "config.json", directory / "digests.json"
    config = json.loads(file.read_text())
    config["training"] |= {"loss": "imitation", "optimizer_lr": 1e-4}
    file.write_text(json.dumps(config))
    stored = json.loads(digests.read_text())
    stored["config.json"] = hashlib.sha256(file.read_bytes()).hexdigest()
    digests.write_text(json.dumps(stored))
    old = loaded(directory, env_cfg=make_env_config("bottle_shaking"))
    assert caplog.text.count("--policy.training.loss, --policy.training.optimizer_lr: ") == 1
    assert torch.equal(act(old, batch(), 5), act(fitted(), batch(), 5))
    old.save_pretrained(directory)
    caplog.clear()
    again = TPGMMPolicy.from_pretrained(directory)
    assert again.config.training == fitted().config.training
    warned = [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
    assert not any("optimizer_lr" in message for message in warned)


# What is refused at load


@pytest.mark.parametrize("release", [{"type": "tpgmm", "n_steps": 30}, {"type": "tpgmm"}])
def test_a_policy_of_an_earlier_release_has_to_be_fitted_again(tmp_path, release):
    (tmp_path / "config.json").write_text(json.dumps(release))
    (tmp_path / "model.safetensors").write_bytes(b"numbers")
    with pytest.raises(ModelFileError, match=r"of release 0\.1 or 0\.2 .* fit it again"):
        TPGMMPolicy.from_pretrained(tmp_path)
    if "n_steps" in release:  # LeRobot's commands read the configuration first
        with pytest.raises(DecodingError, match="fit it again"):
            PreTrainedConfig.from_pretrained(tmp_path)


@pytest.mark.parametrize("keep", [0, 100, 1000])
def test_a_truncated_file_is_refused(directory, keep):
    file = directory / "model" / "model.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ModelFileError, match="truncated"):
        TPGMMPolicy.from_pretrained(directory)
    file.unlink()
    with pytest.raises(ModelFileError, match="is missing"):
        loaded(directory, env_cfg=make_env_config("bottle_shaking"))
    shutil.rmtree(directory / "model")
    with pytest.raises(ModelFileError, match="saved before it was fitted"):
        TPGMMPolicy.from_pretrained(directory)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("n_components", 9, "n_components of the configuration differ .* has 8 components"),
        ("operators", ["canonical"], "operators of the configuration differ"),
        ("operators", ["shake"], "'shake' is not a term"),
        ("operators", ["auto", "canonical"], r"give \['auto'\] alone"),
    ],
)
def test_a_configuration_of_something_else_is_refused(directory, field, value, message):
    config = PreTrainedConfig.from_pretrained(directory)
    setattr(config, field, value)
    with pytest.raises((ModelFileError, DataError), match=message):
        TPGMMPolicy.from_pretrained(directory, config=config)


def test_settings_of_a_fitted_policy_can_be_changed(directory):
    env = make_env_config("bottle_shaking")
    wide = loaded(directory, "--fusion.prior_std=0.01", env_cfg=env)
    assert wide.to_estimator().skill.fusion.prior_std == 0.01
    same(wide.to_estimator(), small_bottle(), 1e-12)


@pytest.mark.parametrize("name", ["config.json", "model/config.json"])
def test_json_that_cannot_be_read_is_refused(directory, name):
    (directory / name).write_text("[" * 100_000)
    with pytest.raises(ModelFileError, match=r"config\.json"):
        TPGMMPolicy.from_pretrained(directory)


@pytest.mark.parametrize("name", ["config.json", *sorted(n for n in FILES if "model/" in n)])
def test_a_pipe_is_refused_at_once(directory, name):
    (directory / name).unlink()
    os.mkfifo(directory / name)
    with pytest.raises(ModelFileError, match=rf"{name}.*not a regular file"):
        TPGMMPolicy.from_pretrained(directory)


def test_a_folder_that_is_not_there_is_not_looked_up_on_the_hub(tmp_path):
    with pytest.raises(ModelFileError, match=r"there is no folder .*polciy"):
        TPGMMPolicy.from_pretrained(tmp_path / "polciy")


def test_the_old_one_is_found_again_where_a_save_died_between_two_renames(directory):
    directory.rename(directory.with_name(".policy.previous"))
    assert TPGMMPolicy.from_pretrained(directory).config == fitted().config


# What is refused because robot, environment or data set are others


def test_an_environment_of_other_actions_is_refused(saved):
    with pytest.raises(ShapeError, match=r"17 entries, but the environment .* shape \(14,\)"):
        loaded(saved, env_cfg=make_env_config("aloha_state"))


def test_the_data_set_of_the_fit_is_accepted(saved):
    same(loaded(saved, ds_meta=dataset()).to_estimator(), small_bottle(), 0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fps": 50}, r"has 50 steps .* was made for 2\.\d+: resample.*--rate 2"),
        ({"names": fitted().kinematics.joint_names[::-1]}, r"--policy.state_names='\[...\]'"),
        ({"names": ("a", "b", "c")}, r"entries \['a', 'b', 'c'\], the policy was made for"),
        ({"action": OTHER}, r"17 entries, but the .* data set has a feature of shape \(14,\)"),
    ],
    ids=["rate", "order", "joints", "size"],
)
def test_another_data_set_is_refused(saved, given, message):
    with pytest.raises(DataError, match=message):
        loaded(saved, ds_meta=dataset(**given))

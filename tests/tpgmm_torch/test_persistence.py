"""Saved models: equal to the bit, or refused."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.support import skills
from tests.support.own_operators import PlanarArm
from tests.support.skills import (
    HANDLING,
    HANDS,
    few_bottles,
    handlings,
    hands,
    hands_model,
    small_bottle,
    waves,
)
from tpgmm_torch import Canonical, Demonstration, RelativePosition, TaskParameterizedGMM
from tpgmm_torch.exceptions import ModelFileError, NotFittedError
from tpgmm_torch.persistence import CONFIG, TENSORS, decode, encode
from tpgmm_torch.robots.joint_space import JointSpace

FILES = (CONFIG, TENSORS)


def canonical(**options) -> TaskParameterizedGMM:
    return TaskParameterizedGMM(**{"n_components": 4, "blend": 0.0, **options}).fit(waves())


@pytest.fixture
def saved(tmp_path) -> Path:
    hands().save(tmp_path / "model")
    return tmp_path / "model"


def refused(path: Path, message: str, **options) -> None:
    with pytest.raises(ModelFileError, match=message) as caught:
        TaskParameterizedGMM.load(path, **options)
    assert isinstance(caught.value, ValueError)


def assert_same(a: TaskParameterizedGMM, b: TaskParameterizedGMM, given) -> None:
    for name in ("weights_", "time_"):
        assert torch.equal(getattr(a, name), getattr(b, name))
    for name in ("means_", "covariances_"):
        for one, other in zip(getattr(a, name), getattr(b, name), strict=True):
            assert torch.equal(one, other) and one.dtype == other.dtype
    for name in ("frame_names_", "n_iter_", "converged_", "lower_bound_", "operators_"):
        assert getattr(a, name) == getattr(b, name)
    assert a.kinematics_ == b.kinematics_
    assert a.score(given) == b.score(given) and a.bic(given) == b.bic(given)
    for one, other in zip(a.predict(given), b.predict(given), strict=True):
        assert torch.equal(one.joints, other.joints)
        assert torch.equal(one.covariance, other.covariance)
        assert one.joint_names == other.joint_names
    [one], [other] = (m.sample(given[0], 1, random_state=0) for m in (a, b))
    assert torch.equal(one.joints, other.joints)


def described(config: dict) -> dict:
    return {k: v for k, v in config.items() if k not in ("operators", "robot")}


# Round trips

MODELS = {
    "robot": lambda: (small_bottle(), list(few_bottles()[:1])),
    "poses": lambda: (hands(), handlings()[:2]),
    "joints": lambda: (canonical(), waves()[:2]),
    "nameless joints": lambda: (
        TaskParameterizedGMM(4).fit(waves(names=None)),
        waves(names=None),
    ),
    "float32": lambda: (canonical(dtype="float32"), waves()[:2]),
    "other settings": lambda: (
        canonical(
            fusion="covariance", activation="product", covariance_type="diag", random_state=3
        ),
        waves()[:1],
    ),
}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_what_is_loaded_is_what_was_saved(make, tmp_path):
    model, given = make()
    model.save(tmp_path / "deep" / "model")
    loaded = TaskParameterizedGMM.load(tmp_path / "deep" / "model")
    assert type(loaded) is TaskParameterizedGMM
    assert described(loaded.get_params()) == described(model.get_params())
    assert list(loaded.operators) == list(model.operators_)
    assert_same(loaded, model, given)
    assert sorted(item.name for item in (tmp_path / "deep" / "model").iterdir()) == [*FILES]


def test_a_robot_comes_back_with_its_model(tmp_path):
    small_bottle().save(tmp_path)
    assert TaskParameterizedGMM.load(str(tmp_path)).robot == small_bottle().robot


def test_what_was_demonstrated_is_kept_and_models_that_do_not_know_it_load(saved, monkeypatch):
    loaded = TaskParameterizedGMM.load(saved)
    assert torch.equal(loaded.acceleration_, hands().acceleration_)
    assert torch.equal(loaded.jerk_, hands().jerk_) and float(loaded.jerk_.max()) > 0
    sealed(saved, monkeypatch, peaks=...)
    older = TaskParameterizedGMM.load(saved)
    assert older.acceleration_ is None and older.jerk_ is None
    assert older.motion_bounds().acceleration.tolist() == [torch.inf] * 14


def test_a_loaded_model_can_be_fitted_and_saved_again(saved, tmp_path):
    loaded = TaskParameterizedGMM.load(saved)
    assert_same(loaded.fit(handlings()), hands(), handlings()[:1])
    loaded.save(tmp_path / "again")
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (saved / name).read_bytes()


def test_settings_found_by_a_search_over_arrays_are_saved(tmp_path):
    settings = {"n_components": np.int64(3), "tol": np.float32(1e-3), "keep_limits": np.True_}
    model = canonical(**settings, random_state=np.random.RandomState(0))
    model.save(tmp_path)
    loaded = TaskParameterizedGMM.load(tmp_path)
    assert loaded.n_components == 3 and loaded.random_state is None
    assert_same(loaded, model, waves())


def test_a_seed_of_numpy_is_kept(tmp_path):
    canonical(random_state=np.int64(5)).save(tmp_path)
    assert TaskParameterizedGMM.load(tmp_path).random_state == 5


@dataclass(frozen=True)
class Scaled(Canonical):
    """An operator of a user's own, with fields of several kinds."""

    factors: tuple[tuple[float, ...], ...] = ((1.0, 0.5), (2.0,))
    label: str = "mine"


class Arm(PlanarArm):
    def config(self):
        return {"length": 1.5}

    @classmethod
    def from_config(cls, config):
        assert config == {"length": 1.5}
        return cls()

    def __eq__(self, other):
        return type(other) is type(self)

    __hash__ = None


def test_operators_and_robots_of_ones_own_are_named_when_loading(tmp_path):
    demonstrations = [Demonstration(d.time, d.joints) for d in waves()]
    model = TaskParameterizedGMM(3, [Scaled(factors=((3.0, 1.0),))], Arm()).fit(demonstrations)
    model.save(tmp_path)
    loaded = TaskParameterizedGMM.load(tmp_path, custom=[Scaled, Arm])
    assert loaded.operators_[0].factors == ((3.0, 1.0),)
    assert hash(loaded.operators_[0]) == hash(model.operators_[0])
    assert_same(loaded, model, demonstrations)
    refused(tmp_path, r"class 'Scaled'.*custom=\[Scaled\]", custom=[Arm])
    refused(tmp_path, r"class 'Arm'.*custom=\[Arm\]", custom=[Scaled])


# What cannot be saved


def test_only_fitted_models_are_saved(tmp_path):
    with pytest.raises(NotFittedError, match="not fitted"):
        hands_model().save(tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_robots_without_a_description_are_not_saved(tmp_path):
    model = TaskParameterizedGMM(3, [Canonical()], PlanarArm())
    model.fit([Demonstration(d.time, d.joints) for d in waves()])
    with pytest.raises(ModelFileError, match=r"PlanarArm cannot be saved.*config\(\)"):
        model.save(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_operators_without_a_description_are_not_saved(tmp_path):
    impostor = type("RelativePosition", (RelativePosition,), {})
    with pytest.raises(ModelFileError, match="name of a built-in"):
        encode(impostor("hand", "cup"))
    model = canonical(operators=[Scaled(factors=(torch.ones(2),))])
    with pytest.raises(ModelFileError, match="JSON"):
        model.save(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


# What is there before


@pytest.mark.parametrize("content", ["notes.txt", "config.json"])
def test_folders_of_something_else_are_left_alone(content, tmp_path):
    (tmp_path / content).write_text('{"type": "act"}')
    with pytest.raises(ModelFileError, match="not a saved model"):
        hands().save(tmp_path)
    assert [item.name for item in tmp_path.iterdir()] == [content]
    assert (tmp_path / content).read_text() == '{"type": "act"}'


def test_files_beside_a_model_are_not_deleted(saved):
    (saved / "notes.txt").write_text("mine")
    with pytest.raises(ModelFileError, match="choose another directory"):
        hands().save(saved)
    assert (saved / "notes.txt").read_text() == "mine"


def test_a_file_in_the_way_is_left_alone(tmp_path):
    (tmp_path / "model").write_text("mine")
    with pytest.raises(ModelFileError, match="not a saved model"):
        hands().save(tmp_path / "model")
    assert (tmp_path / "model").read_text() == "mine"


def test_an_older_model_is_replaced(saved):
    canonical().save(saved)
    assert_same(TaskParameterizedGMM.load(saved), canonical(), waves())


@pytest.mark.parametrize(
    ("owner", "failing"), [(Path, "write_text"), (Path, "write_bytes"), (os, "fsync")]
)
def test_a_save_that_fails_leaves_the_old_model(saved, monkeypatch, owner, failing):
    def fail(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(owner, failing, fail)
    with pytest.raises(KeyboardInterrupt):
        canonical().save(saved)
    monkeypatch.undo()
    assert [item.name for item in saved.parent.iterdir()] == [saved.name]
    assert_same(TaskParameterizedGMM.load(saved), hands(), handlings()[:1])


# Damage


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    refused(saved, f"not a saved model.*{name} is missing")


def test_a_missing_folder_is_named(tmp_path):
    refused(tmp_path / "nowhere", "nowhere is not a saved model")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_truncated_files_are_refused(saved, name, share):
    content = (saved / name).read_bytes()
    (saved / name).write_bytes(content[: int(share * len(content))])
    refused(saved, f"{name}.*(cannot be read|truncated)")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("bit", [0x01, 0x20, 0x80])
def test_a_flipped_bit_gives_no_other_model(saved, name, bit):
    content = (saved / name).read_bytes()
    meant = json.loads((saved / CONFIG).read_text())
    positions = np.unique(np.linspace(0, len(content) - 1, 150).astype(int))
    refusals = 0
    for position in positions:
        damaged = bytearray(content)
        damaged[position] ^= bit
        (saved / name).write_bytes(bytes(damaged))
        try:
            TaskParameterizedGMM.load(saved)
        except ModelFileError:
            refusals += 1
        else:  # white space between the values became other white space
            assert name == CONFIG and json.loads(bytes(damaged)) == meant
    assert refusals > 0.4 * len(positions)


@pytest.mark.parametrize("value", ["7", "6.5", "NaN", "Infinity", "1e999", '"six"', "null"])
def test_an_edited_number_is_refused(saved, value):
    text = (saved / CONFIG).read_text()
    assert '"n_components": 6' in text
    edited = text.replace('"n_components": 6', f'"n_components": {value}')
    (saved / CONFIG).write_text(edited)
    refused(saved, r"config\.json was changed after it was saved")


def test_other_versions_are_refused(saved):
    config = json.loads((saved / CONFIG).read_text())
    (saved / CONFIG).write_text(json.dumps(config | {"version": 2}))
    refused(saved, "format version 2, this release reads version 1")


@pytest.mark.parametrize("text", ["[]", "null", "{}", '{"format": "another"}', "7"])
def test_other_configurations_are_refused(saved, text):
    (saved / CONFIG).write_text(text)
    refused(saved, "does not describe a tpgmm-torch model")


def test_swapped_tensors_are_refused(saved):
    tensors = load_file(saved / TENSORS)
    tensors["means.0"], tensors["means.1"] = tensors["means.1"], tensors["means.0"]
    save_file(tensors, saved / TENSORS)
    refused(saved, "changed after it was saved")


def test_tensors_of_another_model_are_refused(saved, tmp_path):
    hands_model(n_components=5).fit(handlings()).save(tmp_path / "other")
    (saved / TENSORS).write_bytes((tmp_path / "other" / TENSORS).read_bytes())
    refused(saved, "changed after it was saved")


# Contents that were sealed, but make no sense


def sealed(saved: Path, monkeypatch, **changes) -> None:
    """Save again with another configuration and a digest that fits."""
    from tpgmm_torch import persistence

    config = json.loads((saved / CONFIG).read_text()) | changes
    kept = {name: value for name, value in config.items() if value is not ...}
    own = ("format", "version", "tensors", "tensors_sha256", "digest")
    persistence.MODEL.write(
        saved, {k: v for k, v in kept.items() if k not in own}, load_file(saved / TENSORS)
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"peaks": 7},
        {"peaks": [[1.0], [1.0]]},
        {"peaks": [[-1.0] * 14, [1.0] * 14]},
        {"operators": ...},
        {"operators": 7},
        {"operators": [7]},
        {"operators": []},
        {"operators": [encode(HANDLING[0])]},
        {"operators": [encode(HANDLING[0]), encode(Canonical())]},
        {"operators": [{"type": "Stack", "operators": []}] * 2},
        {"operators": [{"type": "RelativePosition", "links": "left"}] * 2},
        {"kinematics": ...},
        {"kinematics": {"type": "Poses", "config": {}}},
        {"kinematics": encode(JointSpace(("a",)))},
        {"kinematics": encode(Canonical())},
        {"parameters": {"n_components": -1}},
        {"parameters": {"n_components": 5}},
        {"parameters": {"surprise": 1}},
        {"parameters": None},
        {"frames": ...},
        {"n_iter": ...},
    ],
    ids=str,
)
def test_parts_that_do_not_fit_together_are_refused(saved, monkeypatch, changes):
    sealed(saved, monkeypatch, **changes)
    refused(saved, "fit together|cannot be rebuilt")


@pytest.mark.parametrize(
    "name", ["os.system", "system", "builtins.eval", "eval", "Path", "object", None, ["Stack"]]
)
def test_nothing_is_imported_or_called_by_name(saved, monkeypatch, name, tmp_path):
    trap = {"type": name, "command": f"touch {tmp_path / 'trap'}", "config": {}}
    sealed(saved, monkeypatch, operators=[trap, trap])
    refused(saved, "not known here|does not fit together")
    assert not (tmp_path / "trap").exists()


@pytest.mark.parametrize("thing", [*HANDLING, Canonical(), HANDS, JointSpace(("a", "b"))])
def test_descriptions_are_plain_json_and_come_back(thing):
    description = json.loads(json.dumps(encode(thing)))
    assert decode(description) == thing


def test_a_model_stands_on_its_files_alone(saved, tmp_path):
    moved = tmp_path / "elsewhere"
    saved.rename(moved)
    [a] = TaskParameterizedGMM.load(moved).predict(handlings()[:1])
    [b] = skills.hands().predict(handlings()[:1])
    assert torch.equal(a.joints, b.joints)


def test_a_model_of_a_device_that_is_not_there_says_so(tmp_path):
    model = canonical()
    model.set_params(device="cuda:99").save(tmp_path / "model")
    refused(tmp_path / "model", r"on the device 'cuda:99', which is not .*device=\"cpu\"")
    assert TaskParameterizedGMM.load(tmp_path / "model", device="cpu").device == "cpu"


def test_a_model_saved_on_another_device_loads_where_it_is_wanted(tmp_path):
    model = canonical()
    model.set_params(device="meta").save(
        tmp_path / "model"
    )  # stands for a GPU that is not here
    loaded = TaskParameterizedGMM.load(tmp_path / "model", device="cpu")
    assert loaded.device == "cpu"
    assert loaded.means_[0].device.type == "cpu"
    assert torch.equal(loaded.means_[0], model.means_[0])

"""Models and skills on disk: what is loaded is what was saved, or an error says why not."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from tests.support.fetching import skills
from tests.support.pressing import wipes, wiping
from tests.support.refusals import refused
from tests.support.skills import (
    HANDLING,
    canonical,
    few_bottles,
    handlings,
    hands,
    hands_model,
    small_bottle,
    waves,
)
from tpgmm_control import rollout
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Hold,
    RelativeOrientation,
    Sequence,
    Situation,
    TaskParameterizedGMM,
    ViaPoints,
    Ways,
    load,
    save,
)
from tpgmm_torch.exceptions import ModelFileError, NotFittedError
from tpgmm_torch.operators import Operator
from tpgmm_torch.persistence import load_model, load_skill
from tpgmm_torch.regression.fusion_forms import CovarianceFusion, InformationFusion
from tpgmm_torch.skills.via_point import ViaPoint
from tpgmm_torch.structure.fit_parts import fit_parts


def parts() -> Sequence:
    return fit_parts(canonical(n_components=6), waves(), [0.9])


def ways() -> Ways:
    one, other = (canonical().fit(waves(names=("a", "b", "c"))) for _ in range(2))
    return Ways((one.skill, other.skill), (0.4, 0.6), (1.0, 2.0))


SKILLS = {
    "regression": lambda: hands().skill,
    "via-points": lambda: ViaPoints(
        canonical().fit(waves()).skill,
        [ViaPoint(1.0, "canonical", {"a": 0.4}, 0.01), ViaPoint(0.5, "canonical", [0, 1, 0])],
        0.5,
    ),
    "parts": parts,
    "ways": ways,
}
TANGENT = RelativeOrientation("left", "cup", geometry="tangent")
THREE, STRICT = [*HANDLING, Canonical()], InformationFusion(priorities=(1, 1, 0))
LISTED, ARRAY = InformationFusion([2.0] * 14), InformationFusion(np.full(14, 2.0))
MODELS = {
    "hands": hands,
    "robot": small_bottle,
    "joints alone": lambda: canonical(random_state=3).fit(waves()),
    "printed form": lambda: canonical(fusion=CovarianceFusion(1e-3, "product")).fit(waves()),
    "priors": lambda: hands_model(fusion=InformationFusion({"left.x": 2.0})).fit(handlings()),
    "one prior": lambda: hands_model(fusion=InformationFusion(4.0)).fit(handlings()),
    "list of priors": lambda: hands_model(fusion=LISTED).fit(handlings()),
    "array of priors": lambda: hands_model(fusion=ARRAY).fit(handlings()),
    "priorities": lambda: hands_model(operators=THREE, fusion=STRICT).fit(handlings()),
    "tangent space": lambda: hands_model(operators=[TANGENT, Canonical()]).fit(handlings()),
    "forces": wiping,
    "float32": lambda: canonical(dtype="float32", covariance_type="tied").fit(waves()),
}


def shown_to(model: TaskParameterizedGMM) -> Demonstration:
    """A situation for a model of this file."""
    if "board" in model.frame_names_:
        return wipes()[0]
    if "cup" in model.frame_names_:
        return handlings(5)[4]
    return few_bottles()[0] if model.frame_names_ else waves()[1]


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_what_it_was(name, tmp_path):
    model = MODELS[name]()
    save(model, tmp_path / "model")
    files = sorted(file.name for file in (tmp_path / "model").iterdir())
    assert files == ["config.json", "model.safetensors"]
    again, shown = load_model(tmp_path / "model"), shown_to(model)
    [one], [other] = (each.predict([Situation.of(shown)]) for each in (model, again))
    assert torch.equal(one.joints, other.joints)
    assert torch.equal(one.covariance, other.covariance)
    assert one.novelty == other.novelty
    np.testing.assert_array_equal(model.score_samples([shown]), again.score_samples([shown]))
    assert again.operators_ == model.operators_ and again.summary_ == model.summary_
    known = {"operators", "robot", "random_state"}
    known |= {"fusion"} if "of priors" in name else set()  # a tuple of the same numbers
    for parameter, value in model.get_params(deep=False).items():
        if parameter not in known:
            assert getattr(again, parameter) == value, parameter
    for bound, same in zip(model.skill.peaks, again.skill.peaks, strict=True):
        assert torch.equal(bound, same)
    assert again.n_iter_ == model.n_iter_


@pytest.mark.parametrize("name", SKILLS)
def test_a_skill_is_what_it_was(name, tmp_path):
    skill = SKILLS[name]()
    save(skill, tmp_path / "skill")
    again = load(tmp_path / "skill")
    assert type(again) is type(skill)
    for name in ("points", "fade", "gates", "names", "weights", "limits"):
        assert getattr(again, name, None) == getattr(skill, name, None)
    shown = handlings(5)[4] if skill.frame_names else waves()[1]
    [one], [other] = (rollout(each, [shown]) for each in (skill, again))
    assert torch.equal(one.joints, other.joints)
    with pytest.raises(ModelFileError, match="a model of one way and one part"):
        load_model(tmp_path / "skill")
    assert type(load_skill(tmp_path / "skill")) is type(skill)


def test_a_sequence_keeps_its_conditions_and_functions_are_refused(tmp_path):
    text = "pick until held retry 2, place until free retry 1 from pick, home"
    sequence = Sequence.parse(text, skills(), timeout=1.5)
    save(sequence, tmp_path / "skill")
    again = load(tmp_path / "skill")
    assert again.gates == sequence.gates and again.names == sequence.names
    assert again.holds == sequence.holds and again.fade == sequence.fade

    def full(moment: object) -> bool:
        return True

    with pytest.raises(ModelFileError, match=r"the Python function 'full' cannot be saved"):
        save(replace(sequence, until=("held", full, None)), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_what_is_held_is_kept_to_the_end(tmp_path):
    holds = (Hold("cup", "left", 0.5), Hold("cup", "right", -np.inf, 0.2))
    parameters = hands()
    model = TaskParameterizedGMM.from_parameters(
        parameters.weights_,
        parameters.means_,
        parameters.covariances_,
        parameters.time_,
        holds=holds,
        operators=parameters.operators_,
        robot=parameters.kinematics_,
    )
    save(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert again.holds_ == model.holds_ and len(again.holds_) == 2
    assert again.n_demonstrations_ is None and again.summary_ is None


@dataclass(frozen=True)
class Half(Canonical):
    """An operator of a user."""


def test_classes_of_ones_own_are_given(tmp_path):
    model = canonical(operators=[Half()]).fit(waves())
    save(model, tmp_path / "model")
    refused(lambda: load(tmp_path / "model"), ModelFileError, r"custom=\[Half\]")
    assert load(tmp_path / "model", custom=[Half]).operators_ == (Half(),)

    @dataclass(frozen=True)
    class Canonical(Operator):  # type: ignore[misc]
        dimension = linearize = coordinates = None

    named = replace(model.skill, operators=[Canonical.__new__(Canonical)])
    refused(lambda: save(named, tmp_path / "other"), ModelFileError, "rename it")


def test_other_folders_are_left_alone_and_refused(tmp_path):
    refused(lambda: save(canonical(), tmp_path / "model"), NotFittedError)
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "notes.txt").write_text("mine")
    refused(lambda: save(hands(), tmp_path / "else"), ModelFileError, "choose another")
    assert (tmp_path / "else" / "notes.txt").read_text() == "mine"
    refused(lambda: load(tmp_path / "nowhere"), ModelFileError, "is missing")
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "config.json").write_text('{"type": "act"}')
    with pytest.raises(ModelFileError, match="describes no model: it is a LeRobot policy"):
        load(tmp_path / "policy")


def test_a_model_of_before_says_to_fit_again(tmp_path):
    save(hands(), tmp_path / "model")
    file = tmp_path / "model" / "config.json"
    config = json.loads(file.read_text())
    file.write_text(json.dumps(config | {"version": 1}))
    refused(lambda: load(tmp_path / "model"), ModelFileError, "fit again")


def test_devices_that_are_not_there_are_named(tmp_path):
    save(hands(), tmp_path / "model")
    with pytest.raises(ModelFileError, match='device="cpu"'):
        load(tmp_path / "model", device="nonsense:0")
    assert load(tmp_path / "model", device="cpu").device == "cpu"

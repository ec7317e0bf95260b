"""One skill after the other."""

from dataclasses import replace

import pytest
import torch

from tests.support.fetching import skill as of
from tests.support.fetching import skills
from tests.support.refusals import refused
from tests.support.skills import canonical, handlings, hands_model, wave, waves
from tpgmm_control import Controller, rollout
from tpgmm_torch import Canonical, Frame, Hold, SelectOperators, Sequence
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError
from tpgmm_torch.structure.fit_parts import fit_parts


def test_parts_reproduce_the_whole():
    skill = fit_parts(canonical(n_components=8), waves(), [0.7, 1.4])
    assert [len(one.log_weights) for one in skill.skills] == [3, 3, 2]
    assert (skill.begin, skill.end) == (0.0, pytest.approx(2.0, abs=0.1))
    [done] = rollout(skill, waves()[1:2])
    assert float((done.joints - wave(done.time)).abs().max()) < 0.12
    assert float(done.joints.diff(dim=0).abs().max()) < 0.4  # no jump at the seams


def test_shares_are_weights_that_pass_from_one_to_the_next():
    skill = fit_parts(canonical(n_components=6), waves(), [1.0])
    shares = skill.shares(torch.linspace(0, 2, 201, dtype=torch.float64))
    torch.testing.assert_close(shares.sum(-1), torch.ones(201, dtype=torch.float64))
    assert shares[0].tolist() == [1, 0] and shares[-1].tolist() == [0, 1]
    mixed = ((shares > 0) & (shares < 1)).all(-1).sum()
    assert 15 <= int(mixed) <= 21  # 0.2 s


def test_each_part_has_operators_of_its_own():
    operators = [list(hands_model().operators), [Canonical()]]
    skill = fit_parts(hands_model(), handlings(), [1.0], operators)
    assert [len(one.operators) for one in skill.skills] == [2, 1]
    assert skill.frame_names == ("cup",)
    [done] = rollout(skill, handlings(5)[4:])
    assert bool(done.joints.isfinite().all())
    found = fit_parts(
        hands_model(), handlings(6), [1.0], SelectOperators(robot=hands_model().robot)
    )
    assert len(found.skills) == 2


def test_objects_of_later_skills_are_compared_with_the_demonstrations():
    early, late = fit_parts(hands_model(), handlings(), [1.0]).skills
    unaware = replace(early, summary=replace(early.summary, frames={}))
    assert list(Sequence((unaware, late)).summary.frames) == ["cup"]
    [one] = handlings(5)[4:]
    away = {"cup": Frame(one.frames["cup"].position + 4.0, one.frames["cup"].orientation)}
    with pytest.warns(PlausibilityWarning, match="place: cup: "):
        Controller(Sequence((unaware, late)), one.joints[0], away)


def test_controllers_localise_in_it():
    skill = fit_parts(canonical(n_components=6), waves(), [1.0])
    start = waves()[1].joints[0]
    running = Controller(skill, start, clock="localizing", bounds=None)
    for _ in range(60):
        command = running.step(0.05, joints=running.reference)
    assert running.finished and bool(command.reference.isfinite().all())


def test_parts_that_do_not_follow_are_refused():
    model, shown = canonical(n_components=6), waves()
    for cuts, message in (([1.0, 0.5], "follow on each other"), ([3.0], "is not after")):
        refused(lambda cuts=cuts: fit_parts(model, shown, cuts), DataError, message)
    refused(lambda: fit_parts(model, shown, ["grasp"]), UnknownNameError, "'grasp'")
    with pytest.raises(DataError, match="need a component each"):
        fit_parts(canonical(n_components=1), shown, [1.0])
    with pytest.raises(DataError, match="operators for 1 of 2 parts"):
        fit_parts(model, shown, [1.0], [[Canonical()]])
    early, _, late = fit_parts(model, shown, [0.7, 1.4]).skills
    refused(lambda: Sequence((early, late)), DataError, "cannot follow")


def test_skills_that_were_learned_separately_each_keep_their_time():
    sequence = Sequence((of("pick"), of("place"), of("home")), fade=0.4)
    assert [gate.time for gate in sequence.gates] == pytest.approx([2.0, 4.4])
    assert sequence.end == pytest.approx(6.8) and len(sequence.time) == 171
    assert float(sequence.time.diff().min()) > 0.039  # the seams have time steps too
    times = torch.tensor([2.0, 2.1, 2.4, 3.4, 4.4, 4.5, 6.8], dtype=torch.float64)
    assert sequence.leading(times).tolist() == [0, 1, 1, 1, 1, 2, 2]
    assert sequence.time_of(1, times).tolist() == pytest.approx([0, 0, 0, 1, 2, 2, 2])
    nested = Sequence((of("home"), sequence), names=("back", "fetch"))
    assert [gate.time for gate in nested.gates] == pytest.approx([2.0, 5.0, 7.4])
    parts = fit_parts(canonical(n_components=6), waves(), [1.0])
    assert parts.gates == () and parts.fade == 0.2


def test_what_a_skill_ends_holding_is_held_until_another_lets_go():
    sequence = Sequence((of("pick"), of("place"), of("home")), fade=0.5)
    assert sequence.holds == (Hold("cup", "hand", 1.3, 2.5 + 1.3),)
    unaware = Sequence((of("pick"), of("home"), of("place")), fade=0.5)
    assert unaware.holds == (Hold("cup", "hand", 1.3, 5.0 + 1.3),)
    twice = Sequence((of("pick"), of("place"), of("pick")), names="abc", fade=0.5)
    assert [hold.begin for hold in twice.holds] == pytest.approx([1.3, 5.0 + 1.3])


def test_a_line_of_text_is_a_sequence():
    text = "pick until held+arrived retry 2, home, place until contact:hand retry 1 from pick"
    sequence = Sequence.parse(text, skills(), timeout=1.5)
    assert sequence.names == ("pick", "home", "place")
    assert sequence.until == (("held", "arrived"), (), ("contact:hand",))
    assert sequence.retry == ((2, 0), (0, 1), (1, 0))
    last = sequence.gates[-1]
    assert (last.time, last.back, last.retries, last.timeout) == (sequence.end, 0.0, 1, 1.5)
    by_path = Sequence.parse("out/pick, out/home", lambda path: of(path.removeprefix("out/")))
    assert by_path.names == ("pick", "home")
    for wrong, message in (
        ("pick if held", "'pick if held' .* is not of the form NAME"),
        ("home until held", "no object is held by the end"),
        ("pick until free", "no object is free by the end"),
        ("pick retry 1 from home, home", "from itself or from a skill before it"),
        ("pick, pick", "2 skills need a name each"),
    ):
        refused(lambda wrong=wrong: Sequence.parse(wrong, skills()), DataError, message)
    for wrong, message in (
        ("lift", "'lift'.*pick"),
        ("pick until holds", "'holds'.*arrived"),
        ("pick until contact:", "'contact:'.*contact:hand"),
        ("pick until contact:foot", "'contact:foot'.*contact:hand"),
        ("pick retry 1 from lift", "'lift'.*pick"),
    ):
        refused(lambda wrong=wrong: Sequence.parse(wrong, skills()), UnknownNameError, message)


@pytest.mark.parametrize(("options", "message"), [
    ({"until": ["held"]}, "until has 1 entries for 2 skills"),
    ({"retry": [-1, 0]}, "a number of times"),
    ({"timeout": 0.0}, "a positive fade and timeout"),
    ({"fade": float("nan")}, "a positive fade and timeout"),
])  # fmt: skip
def test_what_makes_no_sequence_is_refused(options, message):
    refused(lambda: Sequence((of("pick"), of("home")), **options), DataError, message)
    with pytest.raises(UnknownNameError, match=r"condition 3 .* a function"):
        Sequence((of("pick"), of("home")), until=3)

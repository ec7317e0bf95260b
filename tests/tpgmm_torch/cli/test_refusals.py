"""How the command ``tpgmm`` refuses, and what its options mean."""

import warnings

import pytest

from tests.support.command_line import refusal, run
from tpgmm_torch.cli.options import parse_episodes, parse_frames, parse_units
from tpgmm_torch.exceptions import ConvergenceWarning, DataError, ModelFileError

BAD_INPUT = {
    "no such command": (("fot",), "No such command 'fot'"),
    "no data set": (("fit", "--out", "x"), "Missing argument"),
    "no folder": (("fit", "nowhere", "--out", "x"), "there is no folder nowhere"),
    "no components": (("fit", "x", "--out", "y", "--n-components", "0"), "--n-components"),
    "no such choice": (("fit", "x", "--out", "y", "--fusion", "sum"), "--fusion"),
    "no operator": (("fit", "x", "--out", "y", "--operator", "hand"), "is not a term"),
    "link without robot": (("fit", "x", "--out", "y", "--link", "l_hand"), "need --robot"),
    "no such link": (
        ("fit", "x", "--out", "y", "--robot", "upper_body", "--link", "hand"),
        "'hand'",
    ),
    "no such URDF": (("fit", "x", "--out", "y", "--robot", "no.urdf"), "no.urdf"),
    "no model": (("reproduce", "x", "--dataset", "y", "--out", "z.csv"), "x is not a saved"),
    "no situations": (("reproduce", "x", "--out", "z.csv"), "give either --situations"),
    "no such format": (("reproduce", "x", "--dataset", "y", "--out", "z.txt"), "z.txt"),
    "no data set to check": (("dataset", "check", "nowhere"), "there is no folder"),
}


@pytest.mark.parametrize(("arguments", "message"), BAD_INPUT.values(), ids=BAD_INPUT)
def test_bad_input_ends_in_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_debug_lets_the_error_through():
    result = run("--debug", "reproduce", "x", "--dataset", "y", "--out", "z.csv")
    assert isinstance(result.exception, ModelFileError)


def test_what_is_no_error_of_the_user_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("tpgmm_datasets.describe_lerobot", lambda path: 1 / 0)
    assert isinstance(run("dataset", "check", "x").exception, ZeroDivisionError)


def test_a_missing_package_is_named_with_the_extra_that_has_it(monkeypatch):
    def missing(path):
        raise ModuleNotFoundError("No module named 'pyarrow'", name="pyarrow")

    monkeypatch.setattr("tpgmm_datasets.describe_lerobot", missing)
    line = refusal("dataset", "check", "x")
    assert line == "tpgmm: this command needs pyarrow: pip install 'tpgmm-torch[cli]'"


def test_warnings_are_one_line_each(monkeypatch):
    def warn(path):
        warnings.warn("it did not\nconverge", ConvergenceWarning, stacklevel=1)
        raise DataError("the rest")

    monkeypatch.setattr("tpgmm_datasets.describe_lerobot", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        result = run("dataset", "check", "x")
    lines = ["tpgmm: warning: it did not converge", "tpgmm: the rest"]
    assert result.stderr.splitlines() == lines


def test_episodes_units_and_frames_are_read_from_text():
    assert parse_episodes(None) is None
    assert parse_episodes("0:10") == slice(0, 10)
    assert parse_episodes(":-2") == slice(None, -2)
    assert parse_episodes("0,3,5") == [0, 3, 5]
    assert parse_episodes("4") == [4]
    assert parse_episodes("shake the bottle") == "shake the bottle"
    assert parse_units([]) == "auto"
    assert parse_units(["deg"]) == "deg"
    assert parse_units(["arm=deg", "gripper=raw"]) == {"arm": "deg", "gripper": "raw"}
    frames = parse_frames(["a", "b=poses", "c=poses[7:14]", "d=hand@close"])
    assert frames["a"].feature == "observation.environment_state"
    assert (frames["b"].feature, frames["b"].columns) == ("poses", None)
    assert frames["c"].columns == slice(7, 14)
    assert (frames["d"].link, frames["d"].event) == ("hand", "close")
    assert parse_frames([]) is None


@pytest.mark.parametrize("texts", [["a="], ["=b"], ["a=b[1]"], ["a=b@"], ["a@b"]])
def test_a_frame_that_is_none_is_refused(texts):
    with pytest.raises(DataError, match="is none of NAME, NAME=FEATURE"):
        parse_frames(texts)


@pytest.mark.parametrize("texts", [["deg", "rad"], ["deg", "a=rad"], ["a="], ["=deg"]])
def test_units_for_all_and_for_some_do_not_mix(texts):
    with pytest.raises(DataError, match="units are one for all"):
        parse_units(texts)

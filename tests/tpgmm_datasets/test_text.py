"""What the options of the command line say of a data set."""

import pytest

from tpgmm_datasets.events import SignalEvent, Stop
from tpgmm_datasets.text import (
    parse_episodes,
    parse_events,
    parse_frames,
    parse_joint_names,
    parse_units,
)
from tpgmm_torch.exceptions import DataError


def test_episodes_units_and_frames_are_read_from_text():
    assert parse_episodes(None) is None
    assert parse_episodes("0:10") == slice(0, 10)
    assert parse_episodes(":-2") == slice(None, -2)
    assert parse_episodes("0,3,5") == [0, 3, 5]
    assert parse_episodes("4") == [4]
    assert parse_episodes("shake the bottle") == "shake the bottle"
    assert parse_units([]) == {"units": "auto", "calibration": None}
    assert parse_units(["deg"])["units"] == "deg"
    assert parse_units(["arm=deg", "gripper=raw"])["units"] == {"arm": "deg", "gripper": "raw"}
    assert parse_units(["arm.json", "gripper=raw"]) == {
        "units": {"gripper": "raw"},
        "calibration": {"": "arm.json"},
    }
    assert parse_units(["deg", "*gripper=raw"])["units"] == {"*": "deg", "*gripper": "raw"}
    two = ["left_=l.json", "right_=r.json"]
    assert parse_units(two)["calibration"] == {"left_": "l.json", "right_": "r.json"}
    frames = parse_frames(["a", "b=poses", "c=poses[7:14]", "d=hand@close"])
    assert frames["a"].feature == "observation.environment_state"
    assert frames["b"] == "poses"
    assert frames["c"].columns == slice(7, 14)
    assert frames["d"] == "hand@close"
    texts = ["e = a@b/[1]=poses.csv", "f=hand@close+0,0,-0.1"]
    assert parse_frames(texts) == {"e": "a@b/[1]=poses.csv", "f": "hand@close+0,0,-0.1"}
    assert parse_frames([]) is None


def test_joint_names_are_read_from_text():
    assert parse_joint_names([]) is None
    assert parse_joint_names(["main = elbow", "b=c"]) == {"main": "elbow", "b": "c"}
    assert parse_joint_names(["a, b,c"]) == ["a", "b", "c"]
    assert parse_joint_names(["robot"]) == "robot"


def test_events_are_read_from_text():
    assert parse_events([]) is None
    found = parse_events(["close=closing:*gripper*, thumb", "still=stop:l_hand:2"])
    close = SignalEvent(("*gripper*", "thumb"), "begin", "low")
    assert found == {"close": close, "still": Stop("l_hand", 2)}


FRAME, ONCE = "is not NAME, NAME=FEATURE", "units are one for all"


@pytest.mark.parametrize(
    ("parse", "texts", "message"),
    [
        *((parse_frames, [text], FRAME) for text in ("a=", "=b", "a=b[1]", "a=b@", "a@b")),
        (parse_frames, ["a=b", "a=c"], FRAME),
        (parse_joint_names, ["a", "b=c"], "not STORED"),
        (parse_joint_names, ["=a"], "not"),
        (parse_joint_names, ["a=b", "a=c"], "twice"),
        (parse_events, ["close"], "not NAME=HOW"),
        (parse_events, ["=closing:a"], "not NAME=HOW"),
        (parse_events, ["a=stop:x", "a=stop:y"], "given twice"),
        (parse_events, ["a=closing"], "cannot be found. There are closing:SIGNALS"),
        (parse_events, ["a=closing:b,"], "needs their names"),
        (parse_events, ["a=shutting:b"], "cannot be found"),
        (parse_events, ["a=stop:x:0"], "counted from 1"),
        (parse_events, ["a=stop:x:second"], "cannot be found"),
        *((parse_units, texts, ONCE) for texts in (["deg", "rad"], ["a=deg", "a=rad"])),
        *((parse_units, texts, ONCE) for texts in (["a="], ["=deg"], ["=a=deg"])),
    ],
)
def test_other_texts_are_refused(parse, texts, message):
    with pytest.raises(DataError, match=message):
        parse(texts)

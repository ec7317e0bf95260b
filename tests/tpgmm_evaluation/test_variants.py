"""Policies with settings, as text."""

import pytest

from lerobot_policy_tpgmm.processor_tpgmm import make_tpgmm_pre_post_processors
from lerobot_policy_tpgmm.settings import ControlConfig
from tests.support.policies import fitted
from tpgmm_evaluation.rollouts import Runner
from tpgmm_evaluation.variants import OPEN_LOOP, Variant
from tpgmm_torch.exceptions import DataError, UnknownNameError


@pytest.mark.parametrize(
    ("text", "name", "options"),
    [
        ("act", "act", ()),
        (
            "tpgmm --policy.control.feedback=observation --policy.control.blend=0.5",
            "tpgmm",
            ("control.feedback=observation", "control.blend=0.5"),
        ),
    ],
)
def test_settings_follow_the_name(text, name, options):
    variant = Variant.parse(text)
    assert variant == Variant(name, options)
    assert variant.arguments == [f"--{option}" for option in options]


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (
            "tpgmm feedback=observation",
            DataError,
            "look like --policy.control.feedback=observation",
        ),
        ("tpgmm --policy.control.blend", DataError, "got '--policy.control.blend'"),
        ("act --policy.control.blend=1", DataError, "only tpgmm policies take settings"),
        ("tpgmm --policy.rain=1", UnknownNameError, "field 'rain' is not in the policy"),
    ],
)
def test_what_is_no_setting_is_refused(text, error, message):
    with pytest.raises(error, match=message):
        Variant.parse(text)


def test_the_open_loop_plays_by_the_clock_and_looks_once(tmp_path):
    for part in (fitted(), *make_tpgmm_pre_post_processors(fitted().config)):
        part.save_pretrained(tmp_path)
    config = Runner.load(tmp_path, Variant.parse(OPEN_LOOP).arguments).policy.config
    assert (config.control.feedback, config.control.follow_frames) == ("reference", False)
    assert config.control.largest_start_gap is None
    usual = Runner.load(tmp_path).policy.config
    assert usual.control == ControlConfig()

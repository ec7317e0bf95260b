"""What all cells of a comparison have in common."""

import pytest

from lerobot_policy_tpgmm.evaluation.settings import Settings
from tpgmm_torch.exceptions import DataError, UnknownNameError


def test_a_folder_keeps_its_settings(tmp_path):
    path = tmp_path / "settings.json"
    settings = Settings(episodes=7)
    settings.keep(path)
    settings.keep(path)
    with pytest.raises(DataError, match="episodes was 7, now 8"):
        Settings(episodes=8).keep(path)
    path.write_text("{")
    with pytest.raises(DataError, match="not JSON"):
        settings.keep(path)


def test_conditions_become_options_of_the_environment():
    settings = Settings(options={"mode": "kinematic"})
    assert settings.disturbed("nominal") == {"mode": "kinematic"}
    both = settings.disturbed("pushes+noise")
    assert both == {"mode": "kinematic", "pushes": True, "noise": 1.0}
    stopped = settings.disturbed("stopped-3+noise+live")
    assert stopped == {"mode": "kinematic", "noise": 1.0, "condition": "stopped-3+live"}
    with pytest.raises(UnknownNameError, match=r"'rain' is not in the conditions .*stopped-3"):
        settings.disturbed("rain")
    with pytest.raises(DataError, match="names stopped twice"):
        settings.disturbed("stopped-3+stopped-4")
    with pytest.raises(UnknownNameError, match="'live' is not in the conditions of aloha"):
        Settings("aloha_state").disturbed("live")
    with pytest.raises(UnknownNameError, match="environment 'moon'"):
        Settings("moon").benchmark()


def test_all_conditions_of_a_benchmark_can_be_made():
    for settings in (Settings(), Settings("aloha_state")):
        conditions = settings.benchmark().all_conditions
        assert conditions[0] == "nominal" and len(set(conditions)) == len(conditions)
        made = [settings.disturbed(condition) for condition in conditions]
        assert all(made.count(options) == 1 for options in made)

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
    with pytest.raises(UnknownNameError, match="'rain' is not in the conditions"):
        settings.disturbed("rain")
    with pytest.raises(UnknownNameError, match="environment 'moon'"):
        Settings("moon").benchmark()

"""What all cells of a comparison have in common."""

import pytest

from tpgmm_evaluation.settings import Settings
from tpgmm_torch.exceptions import DataError, UnknownNameError


def test_a_folder_keeps_its_settings(tmp_path):
    path = tmp_path / "settings.json"
    settings = Settings(episodes=7)
    settings.keep(path)
    settings.keep(path)
    with pytest.raises(DataError, match="episodes was 7, now 8"):
        Settings(episodes=8).keep(path)
    assert Settings.read(path) == settings
    with pytest.raises(DataError, match="demonstration_seed was None, now 0"):
        Settings(episodes=7, demonstration_seed=0).keep(path)
    path.write_text("{")
    with pytest.raises(DataError, match="not JSON"):
        settings.keep(path)
    for content in ("[1]", '{"moons": 2}'):
        path.write_text(content)
        with pytest.raises(DataError, match="no settings of a comparison"):
            Settings.read(path)
    with pytest.raises(DataError, match="cannot be read"):
        Settings.read(tmp_path / "none.json")


def test_each_seed_draws_demonstrations_unless_they_are_fixed(tmp_path):
    assert [Settings().drawn(seed) for seed in (0, 3)] == [0, 3]
    fixed = Settings(demonstration_seed=7)
    assert [fixed.drawn(seed) for seed in (0, 3)] == [7, 7]
    assert Settings().episodes_in(tmp_path, 3) == tmp_path / "episodes" / "s3"
    assert fixed.episodes_in(tmp_path, 3) == tmp_path / "episodes" / "s7"


def test_conditions_become_options_of_the_environment():
    settings = Settings(options={"mode": "kinematic"})
    assert settings.disturb("nominal") == {"mode": "kinematic"}
    both = settings.disturb("pushes+noise")
    assert both == {"mode": "kinematic", "pushes": True, "noise": 1.0}
    stopped = settings.disturb("stopped-3+noise+live")
    assert stopped == {"mode": "kinematic", "noise": 1.0, "condition": "stopped-3+live"}
    with pytest.raises(UnknownNameError, match=r"'rain' is not in the conditions .*stopped-3"):
        settings.disturb("rain")
    with pytest.raises(DataError, match="names stopped twice"):
        settings.disturb("stopped-3+stopped-4")
    with pytest.raises(UnknownNameError, match="'live' is not in the conditions of aloha"):
        Settings("aloha_state").disturb("live")
    with pytest.raises(UnknownNameError, match="environment 'moon'"):
        Settings("moon").benchmark()


def test_all_conditions_of_a_benchmark_can_be_made():
    for settings in (Settings(), Settings("aloha_state")):
        conditions = settings.benchmark().all_conditions
        assert conditions[0] == "nominal" and len(set(conditions)) == len(conditions)
        made = [settings.disturb(condition) for condition in conditions]
        assert all(made.count(options) == 1 for options in made)

"""What all cells of a comparison have in common."""

import pytest

from tpgmm_evaluation.settings import Settings
from tpgmm_torch.exceptions import DataError, UnknownNameError


def test_a_folder_keeps_its_settings(tmp_path):
    path, settings = tmp_path / "settings.json", Settings(episodes=7)
    settings.keep(path)
    settings.keep(path)
    for other, message in (
        (Settings(episodes=8), "episodes was 7, now 8"),
        (Settings(episodes=7, demonstration_seed=0), "demonstration_seed was None, now 0"),
    ):
        with pytest.raises(DataError, match=message):
            other.keep(path)
    assert Settings.read(path) == settings
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
    for condition, more in (
        ("nominal", {}),
        ("pushes+noise", {"pushes": True, "noise": 1.0}),
        ("stopped-3+noise+live", {"noise": 1.0, "condition": "stopped-3+live"}),
    ):
        assert settings.disturb(condition) == {"mode": "kinematic", **more}
    for given, condition, error, message in (
        (settings, "rain", UnknownNameError, r"'rain' is not in the conditions .*stopped-3"),
        (settings, "stopped-3+stopped-4", DataError, "names stopped twice"),
        (Settings("aloha_state"), "live", UnknownNameError, "'live' is .* conditions of aloha"),
    ):
        with pytest.raises(error, match=message):
            given.disturb(condition)
    with pytest.raises(UnknownNameError, match="environment 'moon'"):
        Settings("moon").benchmark()


def test_all_conditions_of_a_benchmark_can_be_made():
    for settings in (Settings(), Settings("aloha_state")):
        conditions = settings.benchmark().all_conditions
        assert conditions[0] == "nominal" and len(set(conditions)) == len(conditions)
        made = [settings.disturb(condition) for condition in conditions]
        assert all(made.count(options) == 1 for options in made)

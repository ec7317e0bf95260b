"""Policies and environments come from a hub as LeRobot fetches them."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.envs.factory import make_env

from lerobot_env_bimanual import CarryAndPutConfig
from lerobot_policy_tpgmm.modeling_tpgmm import TPGMMPolicy
from tests.support.hub_server import local_hub
from tests.support.policies import act, batch, fitted

ENV = Path(__file__).parents[2] / "examples" / "envhub" / "env.py"


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with local_hub(monkeypatch, tmp_path / "cache") as hub:
        yield hub


def test_a_policy_comes_back_from_the_hub(hub):
    policy = fitted()
    policy.push_to_hub("lab/shake", measured={"success": "50 of 50"}, license="mit")
    files = hub.repositories["lab/shake"]
    assert {name for name in files if name.endswith("processor.json")}
    card = files["README.md"].decode()
    assert "library_name: lerobot" in card
    assert "| success | 50 of 50 |" in card
    assert "--policy.path=lab/shake" in card
    again = TPGMMPolicy.from_pretrained("lab/shake")
    assert torch.equal(act(again, batch(), 5), act(policy, batch(), 5))


def test_lerobot_loads_the_environments_from_the_hub(hub, tmp_path):
    hub.repositories["lab/bottle"] = {"env.py": ENV.read_bytes()}
    with pytest.raises(RuntimeError, match="Refusing to execute"):
        make_env("lab/bottle")
    options = {"trust_remote_code": True, "hub_cache_dir": tmp_path / "envs"}
    made = make_env("lab/bottle", n_envs=2, **options)
    [vector] = made["bottle_shaking"].values()
    observation, _ = vector.reset(seed=[0, 1])
    assert observation["agent_pos"].shape == (2, 17)
    vector.close()


def test_a_configuration_asks_for_another_task():
    make = runpy.run_path(str(ENV))["make_env"]
    made = make(n_envs=1, cfg=SimpleNamespace(task="carry_and_put"))
    [vector] = made[CarryAndPutConfig().type].values()
    observation, _ = vector.reset(seed=0)
    assert observation["environment_state"].shape == (1, 14)
    vector.close()

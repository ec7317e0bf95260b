"""The perceptron learns by the same loop as the other baselines."""

from dataclasses import replace

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from tpgmm_evaluation.baselines import RECIPES, train
from tpgmm_evaluation.policies.episodes import Episodes
from tpgmm_evaluation.policies.perceptron import PerceptronPolicy

FPS = 20


def towards(*goals, length=40):
    """Two joints go to where an object is."""
    parts = []
    for goal in goals:
        way = torch.linspace(0, 1, length)[:, None] * torch.tensor([goal, -goal])
        parts.append((way, torch.full((length, 3), goal), torch.cat((way[1:], way[-1:]))))
    return Episodes.join(FPS, parts)


def test_a_perceptron_learns_goes_to_a_file_and_back(tmp_path):
    recipe = replace(RECIPES["mlp"], check_every=100, jitter=0.0)
    trained = train(recipe, towards(0.5, 1.0, 1.5, 2.0), towards(1.2), seed=0, budget=4.0)
    assert trained.curve[-1]["validation_error"] < 0.03
    trained.policy.save_pretrained(tmp_path)
    preprocessor, postprocessor = trained.processors
    loaded = PerceptronPolicy.from_pretrained(tmp_path)
    given = {
        OBS_STATE: torch.tensor([[0.0, 0.0], [0.6, -0.6]]),
        OBS_ENV_STATE: torch.tensor([[1.2] * 3, [0.8] * 3]),
    }
    seen = preprocessor(dict(given))
    chunk = loaded.predict_action_chunk(seen)
    assert chunk.shape == (2, 8, 2)
    taken = [postprocessor(loaded.select_action(seen)) for _ in range(8)]
    torch.testing.assert_close(
        torch.stack(taken, dim=1), torch.stack([postprocessor(a) for a in chunk.unbind(1)], 1)
    )
    alone = loaded.predict_action_chunk({k: seen[k][1:] for k in (OBS_STATE, OBS_ENV_STATE)})
    torch.testing.assert_close(alone[0], chunk[1])
    # 10 Hz of 20: after one step the first joint is two rows further
    assert abs(float(taken[0][0, 0]) - 1.2 * 2 / 39) < 0.05


def test_actions_beyond_the_end_do_not_count():
    recipe = replace(RECIPES["mlp"], check_every=1)
    policy = train(recipe, towards(1.0), towards(1.0), seed=0, budget=0.0).policy
    given = {
        OBS_STATE: torch.zeros(1, 2),
        OBS_ENV_STATE: torch.zeros(1, 3),
        "action": torch.zeros(1, 8, 2),
        "action_is_pad": torch.arange(8)[None] >= 3,
    }
    given["action"][:, 3:] = 1e6
    assert policy(given)[0] < 10

"""Results of a comparison that nobody ran."""

import numpy as np

from tpgmm_evaluation.cells import Cell

LATENCIES = ("step_median_ms", "step_p99_ms", "chunk_median_ms", "chunk_p99_ms")


def result(
    policy,
    count,
    successes,
    condition="nominal",
    seed=0,
    env="bottle_shaking",
):
    """The first ``successes`` of 20 episodes succeed, or those whose numbers are listed."""
    rng = np.random.default_rng(count)
    if isinstance(successes, int):
        successes = range(successes)
    episodes = [
        {
            "seed": 100 + i,
            "success": i in successes,
            "grasp_mm": 1.0 if i in successes else float("inf"),
            "grasp_deg": float(rng.uniform(0, 4)),
            "lift_mm": 80.0,
            "frequency_error": 0.01,
            "amplitude_error": 0.3 if i % 2 else 0.1,
        }
        for i in range(20)
    ]
    return {
        "cell": vars(Cell(env, policy, count, seed, condition)),
        "settings": {"env": env, "options": {}, "demonstration_seed": seed},
        "training": {
            "fps": 10,
            "seconds": 12.0,
            "parameters": 1234567,
            "bytes": 5e6,
            "outcome": "learned",
        },
        "evaluation_seconds": 3.0,
        "latency": {
            "chunk_size": 8.0,
            **dict.fromkeys(LATENCIES, 0.5),
        },
        "episodes": episodes,
        "versions": {"torch": "1"},
        "machine": {"processors": 2},
    }


RESULTS = [
    result("nearest", 5, 0),
    result("tpgmm", 5, 20),
    result("act", 5, 0),
    result("tpgmm", 10, 20),
    result("tpgmm", 10, 17, condition="pushes+noise"),
    result("act", 10, 18),
]
#: The same policy with other settings, where something goes wrong.
DISTURBED = [
    result("tpgmm", 10, 20, condition="stopped-3"),
    result("tpgmm-open-loop", 10, 2, condition="stopped-3"),
    result("tpgmm --policy.control.blend=0", 10, 3, condition="stopped-3"),
]

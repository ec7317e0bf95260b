"""Opening a lid that the other hand steadies, and what can go wrong with it."""

import numpy as np

from lerobot_env_bimanual.suite.lid import AREA
from lerobot_env_bimanual.suite.tasks import suite_task

TASK = suite_task("lid")


def test_boxes_stand_where_the_task_is_meant_for_them_and_the_seed_says_where():
    rng = np.random.default_rng(0)
    drawn = [TASK.draw(rng)["box"] for _ in range(50)]
    assert all(map(TASK.usual, drawn)) and not TASK.usual(drawn[0] + np.eye(7)[1])
    positions = np.array(drawn)[:, :3]
    assert (np.ptp(positions, axis=0) > 0.8 * np.subtract(AREA.highest, AREA.lowest)).all()
    again = TASK.draw(np.random.default_rng(0))["box"]
    np.testing.assert_array_equal(again, drawn[0])

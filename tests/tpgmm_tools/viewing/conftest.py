"""A page of the paper's skill."""

import pytest

from tests.support import skills
from tests.support.recordings import FPS, Recording
from tpgmm_tools.viewing import write_motion
from tpgmm_torch import Situation


@pytest.fixture(scope="module")
def bottle(tmp_path_factory):
    """The page of the paper's skill at two pictures per second, and the trajectory in it."""
    path = tmp_path_factory.mktemp("view") / "new" / "motion.html"
    demonstrations = skills.few_bottles()
    situation = Situation(demonstrations[1].joints[0], demonstrations[1].frames)
    trajectory = write_motion(
        path, skills.small_bottle(), situation, demonstrations, fps=FPS, title="<shake> & co"
    )
    return Recording(path), trajectory, path

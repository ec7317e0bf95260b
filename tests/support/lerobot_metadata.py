"""What LeRobot tells a policy of a data set of the upper body, without its files."""

from types import SimpleNamespace

from tests.support.policies import ENVIRONMENT, STATE, fitted


def dataset(fps=None, names=None, **features):
    fps, names = fps or fitted().config.fps, names or fitted().kinematics.joint_names
    joints = {"dtype": "float32", "shape": (len(names),), "names": list(names)}
    columns = {
        STATE: joints,
        "action": joints,
        ENVIRONMENT: {"dtype": "float32", "shape": (7,), "names": None},
    }
    episodes = {"episode_index": [0], "dataset_from_index": [0], "dataset_to_index": [9]}
    return SimpleNamespace(
        fps=fps, features={**columns, **features}, episodes=episodes, stats={}, root="no set"
    )

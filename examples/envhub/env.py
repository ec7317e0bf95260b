"""The simulated robots as LeRobot's EnvHub loads them: upload this file as ``env.py``.

    from lerobot.envs.factory import make_env
    envs = make_env("owner/name", n_envs=10, trust_remote_code=True)

What it needs is installed with ``pip install lerobot_env_bimanual``: the file
holds no code of its own. A configuration whose ``task`` is ``carry_and_put``,
``bottle_torque`` or ``aloha_state`` asks for another robot or task than bottle shaking.
"""

from typing import Any

from lerobot.envs.factory import make_env as make
from lerobot.envs.factory import make_env_config

import lerobot_env_bimanual  # registers the environments


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> Any:
    """Vector environments by suite and task, as LeRobot's own ``make_env`` makes them."""
    assert lerobot_env_bimanual
    env_type = getattr(cfg, "task", None) or "bottle_shaking"
    return make(make_env_config(env_type), n_envs=n_envs, use_async_envs=use_async_envs)

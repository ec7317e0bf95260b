import json

import numpy as np
from lerobot.robots import Robot

from .config_bimanual import BimanualConfig

#: What begins so is observed, and not moved.
OBJECTS = ("bottle", "object")


class Bimanual(Robot):
    """Joints are at once where they are sent; what else it observes stands still.

    Names and their order are those of the file ``start``. It takes any number, of any unit.
    """

    config_class = BimanualConfig
    name = "bimanual"

    def __init__(self, config):
        super().__init__(config)
        self.config, self._connected, self._actions = config, False, []
        self._observed = json.loads(config.start.read_text())
        self._seen = {} if config.picture is None else {"front": np.load(config.picture)}

    @property
    def observation_features(self):
        cameras = {name: picture.shape for name, picture in self._seen.items()}
        return dict.fromkeys(self._observed, float) | cameras

    @property
    def action_features(self):
        return {name: float for name in self._observed if not name.startswith(OBJECTS)}

    @property
    def is_connected(self):
        return self._connected

    @property
    def is_calibrated(self):
        return True

    def connect(self, calibrate=True):
        self._connected = True

    def calibrate(self):
        pass

    def configure(self):
        pass

    def get_observation(self):
        return self._observed | self._seen

    def send_action(self, action):
        self._actions.append(dict(action))
        if len(self._actions) <= self.config.stuck_after:
            self._observed |= action
        return action

    def disconnect(self):
        self._connected = False
        self.config.log.write_text(json.dumps(self._actions))

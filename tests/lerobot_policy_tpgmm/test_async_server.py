"""LeRobot's asynchronous inference over loopback: its server and its client."""

import json
import pickle
import re
import threading
import time
from concurrent import futures

import grpc
import pytest
import torch
from lerobot.async_inference import helpers
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import send_bytes_in_chunks

from tests.support.lerobot_commands import PLUGINS
from tests.support.policies import STATE, batch, changed, fitted, pose
from tests.support.skills import bottle_demonstrations
from tpgmm_torch.exceptions import DataError

POSE = [f"bottle_{part}.pos" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
NAMES = [f"{name}.pos" for name in fitted().kinematics.joint_names]


@pytest.fixture
def address(tmp_path, monkeypatch):
    """Where a server listens; a policy of 20 Hz is in the folder ``policy``."""
    monkeypatch.chdir(tmp_path)  # where it is imported it writes a log
    from lerobot.async_inference.policy_server import PolicyServer

    import lerobot_policy_tpgmm.async_server  # noqa: F401  (puts tpgmm among LeRobot's policies)

    policy = changed(
        fitted(), control_fps=20.0, chunk_size=20, state_names=NAMES + POSE, action_names=NAMES
    )
    policy.save_pretrained(tmp_path / "policy")
    server = grpc.server(futures.ThreadPoolExecutor(2))
    config = PolicyServerConfig(host="127.0.0.1", port=8080, fps=20)
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(PolicyServer(config), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(None)


@pytest.fixture
def server(tmp_path, monkeypatch):
    """``main`` of the server, and the addresses at which it would have listened."""
    monkeypatch.chdir(tmp_path)
    from lerobot_policy_tpgmm import async_server

    found = []
    monkeypatch.setattr(async_server, "serve", lambda config: found.append(config.host))
    return async_server.main, found


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]"])
def test_it_serves_this_machine(server, host):
    main, found = server
    main([f"--host={json.dumps(host)}", "--port=8090"])  # YAML
    assert found == [host]


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "192.168.0.7", "[::]", "", "robot.local", "localhost.evil.org"]
)
def test_other_machines_are_refused_unless_allowed(server, host, tmp_path):
    main, found = server
    with pytest.raises(SystemExit, match=rf"^--host={re.escape(host)}: .*--allow-remote"):
        main([f"--host={json.dumps(host)}"])
    file = tmp_path / "server.yaml"
    file.write_text(f"host: {json.dumps(host)}\n")
    with pytest.raises(SystemExit, match="unpickles"):
        main([f"--config_path={file}"])
    assert found == []
    main([f"--host={json.dumps(host)}", "--allow-remote"])
    assert found == [host]


def name_values(state):
    """Of joints and of the bottle, by name."""
    bottle = pose(bottle_demonstrations()[5].frames["bottle"])
    return dict(zip(NAMES + POSE, [*state.tolist(), *bottle.tolist()], strict=True))


def test_pictures_are_not_resized():
    picture = torch.zeros(48, 64, 3, dtype=torch.uint8)
    assert helpers.resize_robot_observation_image(picture, (3, 48, 64)).shape == (3, 48, 64)
    with pytest.raises(DataError, match="64 x 48, it was calibrated for 32 x 24"):
        helpers.resize_robot_observation_image(picture, (3, 24, 32))


def test_chunks_come_over_the_wire_and_go_on(address, tmp_path):
    names = NAMES + POSE
    with grpc.insecure_channel(address) as channel:
        stub = services_pb2_grpc.AsyncInferenceStub(channel)
        stub.Ready(services_pb2.Empty())
        features = {STATE: {"dtype": "float32", "shape": (len(names),), "names": names}}
        specs = RemotePolicyConfig("tpgmm", str(tmp_path / "policy"), features, 20, "cpu")
        stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(specs)))
        state, sent = batch()[STATE][0], []
        for turn in range(4):
            seen = name_values(state) | {"task": "shake"}
            observation = TimedObservation(time.time(), 8 * turn, seen, must_go=True)
            sending = pickle.dumps(observation), services_pb2.Observation
            stub.SendObservations(send_bytes_in_chunks(*sending, silent=True))
            chunk = pickle.loads(stub.GetActions(services_pb2.Empty()).data)
            assert [action.get_timestep() for action in chunk][:2] == [8 * turn, 8 * turn + 1]
            sent += [action.get_action() for action in chunk[:8]]
            state = sent[-1]
    actions = torch.stack(sent)
    torch.testing.assert_close(actions[0], batch()[STATE][0], rtol=0, atol=1e-5)
    assert 0.01 < float(actions.diff(dim=0).abs().max()) < 0.3  # no jump between chunks


# its loggers replace one another, and leave their files open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_client_drives_a_robot(address, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(PLUGINS))
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient
    from lerobot_robot_bimanual import BimanualConfig

    start, log = tmp_path / "start.json", tmp_path / "log.json"
    start.write_text(json.dumps(name_values(batch()[STATE][0])))
    config = RobotClientConfig(
        policy_type="tpgmm", pretrained_name_or_path=str(tmp_path / "policy"), fps=20,
        robot=BimanualConfig(start=start, log=log), actions_per_chunk=20, task="shake",
        server_address=address,
    )  # fmt: skip
    client = RobotClient(config)
    assert client.start()
    loops = {client.receive_actions: (), client.control_loop: ("shake",)}
    threads = [threading.Thread(target=f, args=a, daemon=True) for f, a in loops.items()]
    for thread in threads:
        thread.start()
    began = time.monotonic()
    while len(client.robot._actions) < 45 and time.monotonic() - began < 100:
        time.sleep(0.05)
    client.shutdown_event.set()
    for thread in threads:
        thread.join(30)
    client.stop()
    actions = json.loads(log.read_text())
    sent = torch.tensor([[action[name] for name in NAMES] for action in actions])
    assert len(sent) >= 45  # of chunks of 20
    torch.testing.assert_close(sent[0], batch()[STATE][0], rtol=0, atol=1e-5)
    assert float((sent[-1] - sent[0]).abs().max()) > 0.1
    assert float(sent.diff(dim=0).abs().max()) < 0.3

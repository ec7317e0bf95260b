"""LeRobot's asynchronous inference over loopback: its server, and what its client sends."""

import pickle
import time
from concurrent import futures

import grpc
import torch
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import send_bytes_in_chunks

from tests.support.policies import STATE, batch, changed, fitted, pose
from tests.support.skills import bottle_demonstrations

POSE = [f"bottle_{part}.pos" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
NAMES = [f"{name}.pos" for name in fitted().kinematics.joint_names]


def test_chunks_come_over_the_wire_and_go_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where it is imported it writes a log
    from lerobot.async_inference.policy_server import PolicyServer

    from lerobot_policy_tpgmm import async_server

    names = NAMES + POSE
    policy = changed(
        fitted(), control_fps=20.0, chunk_size=20, state_names=names, action_names=NAMES
    )
    policy.save_pretrained(tmp_path / "policy")
    assert async_server.serve
    server = grpc.server(futures.ThreadPoolExecutor(2))
    config = PolicyServerConfig(host="127.0.0.1", port=8080, fps=20)
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(PolicyServer(config), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            stub = services_pb2_grpc.AsyncInferenceStub(channel)
            stub.Ready(services_pb2.Empty())
            features = {STATE: {"dtype": "float32", "shape": (len(names),), "names": names}}
            specs = RemotePolicyConfig("tpgmm", str(tmp_path / "policy"), features, 20, "cpu")
            stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(specs)))
            state, sent = batch()[STATE][0], []
            for turn in range(4):
                values = [
                    *state.tolist(),
                    *pose(bottle_demonstrations()[5].frames["bottle"]).tolist(),
                ]
                seen = dict(zip(names, values, strict=True)) | {"task": "shake"}
                observation = TimedObservation(time.time(), 8 * turn, seen, must_go=True)
                stub.SendObservations(
                    send_bytes_in_chunks(
                        pickle.dumps(observation), services_pb2.Observation, silent=True
                    )
                )
                chunk = pickle.loads(stub.GetActions(services_pb2.Empty()).data)
                assert [action.get_timestep() for action in chunk][:2] == [
                    8 * turn,
                    8 * turn + 1,
                ]
                sent += [action.get_action() for action in chunk[:8]]
                state = sent[-1]
    finally:
        server.stop(None)
    actions = torch.stack(sent)
    torch.testing.assert_close(actions[0], batch()[STATE][0], rtol=0, atol=1e-5)
    assert 0.01 < float(actions.diff(dim=0).abs().max()) < 0.3  # no jump between chunks

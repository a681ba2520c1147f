"""LeRobot's own ways of driving a robot, with a simulated one: lerobot-rollout, and its policy server and client."""

import json
import socket
import threading

import commands
import maze_robot
import pytest
import torch

from lerobot_unimask import UniMASKPolicy

H = 4
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "goal x", "goal y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}
STATS = {
    "observation.state": {"mean": [1.5, 1.5, 2.0, 2.0], "std": [0.8, 0.8, 1.0, 1.0]},
    "action": {"mean": [0.0, 0.0], "std": [0.7, 0.7]},
    "frame_index": {"max": [199.0]},
    "timestamp": {"max": [1.99]},
}


@pytest.fixture(scope="module")
def checkpoint(tiny_policy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maze") / "checkpoint"
    tiny_policy("gaussian", features=FEATURES, stats=STATS, chunk_size=H).save_pretrained(folder)
    return folder


def rollout(checkpoint, tmp_path, *arguments):
    """What the robot saw and did: (T, 4) and (T, 2)."""
    log = tmp_path / "log.json"
    commands.check(
        "lerobot-rollout",
        f"--policy.path={checkpoint}",
        "--robot.type=maze_robot",
        f"--robot.log={log}",
        "--fps=50",
        "--duration=1",
        "--return_to_initial_position=false",
        *arguments,
        cwd=tmp_path,
    )
    return read(log)


def read(log):
    steps = json.loads(log.read_text())
    return tuple(torch.tensor([step[name] for step in steps]) for name in ("state", "action"))


@pytest.mark.parametrize("steps", [1, 3])
def test_a_synchronous_rollout_sends_what_select_action_answers(checkpoint, tmp_path, steps):
    states, actions = rollout(checkpoint, tmp_path, f"--policy.n_action_steps={steps}")
    assert len(states) > H
    policy = UniMASKPolicy.from_pretrained(checkpoint)
    policy.config.n_action_steps = steps
    expected = torch.cat([policy.select_action({"observation.state": state.unsqueeze(0)}) for state in states])
    torch.testing.assert_close(actions, expected, rtol=1e-5, atol=1e-5)
    assert (states[0] != states[-1]).any()


def test_real_time_chunking_sends_actions_of_chunks_that_go_on_from_those_before(checkpoint, tmp_path, monkeypatch):
    """Each chunk begins with the actions that were on their way while it was worked out."""
    chunks = tmp_path / "chunks.jsonl"
    ask = UniMASKPolicy.predict_action_chunk

    def predict_action_chunk(self, batch, inference_delay=0, prev_chunk_left_over=None):
        chunk = ask(self, batch, inference_delay=inference_delay, prev_chunk_left_over=prev_chunk_left_over)
        left = None if prev_chunk_left_over is None else prev_chunk_left_over.tolist()
        with chunks.open("a") as file:
            file.write(json.dumps({"chunk": chunk[0].tolist(), "delay": inference_delay, "left": left}) + "\n")
        return chunk

    monkeypatch.setattr(UniMASKPolicy, "predict_action_chunk", predict_action_chunk)
    _, actions = rollout(
        checkpoint,
        tmp_path,
        "--inference.type=rtc",
        "--inference.queue_threshold=2",
        "--inference.rtc.execution_horizon=4",
    )
    asked = [json.loads(line) for line in chunks.read_text().splitlines()]
    answered = torch.tensor([one["chunk"] for one in asked])  # (chunks, H, 2)
    assert answered.shape[1:] == (H, 2)
    assert len(actions) > H
    nearest = (actions[:, None] - answered.flatten(0, 1)).abs().amax(-1).amin(-1)
    assert nearest.max() < 1e-6
    handed = [one for one in asked if one["delay"] and one["left"] and any(map(any, one["left"]))]
    assert handed
    for one in handed:
        left = torch.tensor([row for row in one["left"] if any(row)])[: min(one["delay"], H)]
        assert torch.equal(torch.tensor(one["chunk"])[: len(left)], left)


def test_lerobots_client_drives_the_robot_from_the_policy_server(checkpoint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # LeRobot's server and client write logs where they are
    monkeypatch.setenv("GRPC_VERBOSITY", "ERROR")
    import grpc
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient

    from lerobot_unimask import cli

    policy = UniMASKPolicy.from_pretrained(checkpoint)
    policy.config.chunk_size = 1  # as long as the client asks for all the same
    policy.save_pretrained(tmp_path / "short")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    servers = []
    make = grpc.server
    monkeypatch.setattr(grpc, "server", lambda *arguments: servers.append(make(*arguments)) or servers[0])
    server = threading.Thread(target=cli.main, args=(["serve", "--host=127.0.0.1", f"--port={port}", "--fps=100"],))
    server.start()
    robot = maze_robot.MazeRobotConfig(log=tmp_path / "log.json")
    config = RobotClientConfig(
        "unimask", str(tmp_path / "short"), robot, H, server_address=f"127.0.0.1:{port}", fps=100
    )
    client = RobotClient(config)
    try:
        grpc.channel_ready_future(client.channel).result(timeout=60)
        assert client.start()
        threads = [
            threading.Thread(target=client.receive_actions),
            threading.Thread(target=client.control_loop, args=("",)),
        ]
        for thread in threads:
            thread.start()
        for _ in range(600):
            if len(client.robot.log) >= 2 * H:
                break
            threads[1].join(0.05)
    finally:
        client.shutdown_event.set()
        for thread in threads:
            thread.join(10)
        client.stop()
        servers[0].stop(None)
        server.join(10)
    states, actions = read(tmp_path / "log.json")
    assert len(actions) >= 2 * H
    policy.config.chunk_size = H
    first = policy.predict_action_chunk({"observation.state": states[:1]})[0]
    torch.testing.assert_close(actions[0], first[0], rtol=1e-5, atol=1e-5)


def test_the_server_says_what_it_needs(monkeypatch, capsys):
    from lerobot_unimask import cli

    monkeypatch.setitem(__import__("sys").modules, "grpc", None)
    with pytest.raises(SystemExit):
        cli.main(["serve"])
    assert "lerobot_policy_unimask[server]" in capsys.readouterr().err

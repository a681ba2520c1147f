"""`unimask serve`: LeRobot's policy server, with this policy known to it."""

import argparse
from typing import Any

from lerobot_unimask.commands.flags import add_command, positive


def add(commands: Any) -> None:
    parser = add_command(commands, "serve", "LeRobot's policy server, for robots elsewhere")
    parser.add_argument("--host", default="localhost", help="address to listen on; default: %(default)s")
    parser.add_argument("--port", type=positive, default=8080, help="its port; default: %(default)s")
    parser.add_argument("--fps", type=positive, default=30, help="steps of the robot in a second; default: %(default)s")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    try:
        import grpc  # noqa: F401
    except ImportError as error:
        raise ValueError("LeRobot's policy server needs gRPC: pip install 'lerobot_policy_unimask[server]'.") from error
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.policy_server import serve

    from lerobot_unimask import lerobot_patches

    lerobot_patches.make_known_to_policy_server()
    # LeRobot's server waits a thirtieth of a second before it hands a chunk over; ours hands it over at once.
    serve(PolicyServerConfig(arguments.host, arguments.port, arguments.fps, inference_latency=0.0))

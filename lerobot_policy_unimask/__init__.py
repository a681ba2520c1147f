"""Discovery shim: LeRobot imports a module of exactly this distribution's name, and that registers the plugin."""

import lerobot_unimask  # noqa: F401

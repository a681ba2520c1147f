"""Policies that come with the package, a checkpoint's folder each; its README.md says how it was made."""

from pathlib import Path

FOLDERS = {folder.parent.name: folder.parent for folder in sorted(Path(__file__).parent.glob("*/config.json"))}

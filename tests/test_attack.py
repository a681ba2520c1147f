"""A few attempts of each attack. All of them: `python tests/measuring/attack.py`, see docs/reliability.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ATTACK = Path(__file__).with_name("measuring") / "attack.py"


@pytest.mark.slow
def test_nothing_is_lost(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    done = subprocess.run(
        [sys.executable, ATTACK, "--share=0.02", f"--output={tmp_path / 'record.json'}"],
        cwd=ATTACK.parents[2],
        env={**environment, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=580,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]
    attacks = json.loads((tmp_path / "record.json").read_text())["attacks"]
    assert min(entry["tried"] for entry in attacks.values()) >= 2

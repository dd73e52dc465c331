"""The networked example: three processes, UDP on loopback, bounded in time and packets."""

import json
import pathlib
import subprocess
import sys

SCRIPT = pathlib.Path(__file__).parents[1] / "examples" / "lossy_network.py"


def test_the_estimator_finds_what_the_relay_replaced():
    command = [sys.executable, str(SCRIPT), "--packets", "250", "--rate", "500", "--seconds", "30"]
    out = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    *live, last = out.stdout.strip().splitlines()
    score = json.loads(last)
    assert score["packets"] >= 245  # the last ones may be among the dropped
    assert score["replaced"] > 20
    assert score["dropped"] > 0
    assert score["misjudged"] < 0.06
    assert score["rmse"] < 0.4 * score["rmse_believing"]
    assert len(live) >= 9
    assert all("P(real)" in line for line in live)

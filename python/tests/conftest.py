"""What the tests share: the scenarios of the repository, and the command line of the same build."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"


@pytest.fixture
def dipole():
    """A scenario of 1 s that moves in all its parts."""
    scene = json.loads((SCENARIOS / "dipole.json").read_text())
    del scene["expect"]
    return scene | {"steps": 100, "log": {"every": 10}}


@pytest.fixture
def body():
    """A free body."""
    return {
        "name": "body",
        "scene": {
            "inertia": {"principal": [1.0, 2.0, 3.0]},
            "initial": {"angular_velocity": {"body": [0.1, 0.2, 0.3]}},
        },
        "step_s": 0.01,
        "steps": 100,
    }


@pytest.fixture
def command():
    """Runs the command line: that of VPD, or the one that was installed with the package."""
    program = os.environ.get("VPD")
    program = [program] if program else [sys.executable, "-m", "vpdsim"]

    def run(*arguments, check=True):
        return subprocess.run([*program, *map(str, arguments)], check=check, capture_output=True, text=True)

    return run

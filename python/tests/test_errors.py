"""What is wrong with a scenario is said, whatever it is: no panic, and never another exception."""

import copy
import json
import pickle
import random
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SCENARIOS

import vpdsim as vpd


def test_a_scenario_error_is_the_text_of_the_command_line(body, command, tmp_path):
    body["scene"]["inertia"]["principal"][2] = 0.0
    with pytest.raises(vpd.ScenarioError) as caught:
        vpd.check(body)
    error = caught.value
    assert error.pointer == "/scene/inertia/principal/2" and error.given == 0.0
    assert error.allowed == "a moment of inertia must be from 1e-12 to 1e12 kg m^2"
    assert isinstance(error, vpd.Error) and isinstance(error, ValueError)
    (tmp_path / "a.json").write_text(json.dumps(body))
    said = command("plan", tmp_path / "a.json", check=False).stderr
    assert said == f"vpd: {tmp_path / 'a.json'}: {error}\n"
    again = pickle.loads(pickle.dumps(error))
    assert (again.pointer, again.given, str(again)) == (error.pointer, error.given, str(error))
    for call in (vpd.run, vpd.plan, vpd.Simulation):
        with pytest.raises(vpd.ScenarioError, match="/scene/inertia/principal/2"):
            call(body)


def places(tree, at=()):
    """All places in a tree."""
    yield at
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


STRANGE = [None, True, -1, 0, 1e400, float("nan"), 1e-320, 10**40, "", "x", "\ud800", [], {}, [1, 2], {"kind": "none"}, [[1], [2]],
           [0.0, 0.0, 0.0], "1"]


def spoilt(scene, chance):
    """The scene with a few places of another kind, gone, or twice."""
    scene = copy.deepcopy(scene)
    for _ in range(chance.randint(1, 3)):
        at = chance.choice(list(places(scene))[1:])
        parent = scene
        for key in at[:-1]:
            parent = parent[key]
        what = chance.randrange(4)
        if what == 0:
            del parent[at[-1]]
        elif what == 1 and isinstance(parent, dict):
            parent[chance.choice(["colour", "kind", "step_s", "body"])] = copy.deepcopy(chance.choice(STRANGE))
        elif isinstance(parent[at[-1]], float | int) and what == 2:
            parent[at[-1]] = parent[at[-1]] * chance.choice([-1, 0, 1e-30, 1e30])
        else:
            parent[at[-1]] = copy.deepcopy(chance.choice(STRANGE))
        if not any(True for _ in places(scene)) or not scene:
            break
    return scene


def test_two_hundred_spoilt_scenarios():
    """Each one is accepted or refused with the pointer of a field of it, or of one that is missing."""
    chance = random.Random(20260101)
    shipped = [json.loads(path.read_text()) for path in sorted(SCENARIOS.glob("*.json")) if "schema" not in path.name]
    refused = 0
    for _ in range(200):
        scene = spoilt(chance.choice(shipped), chance)
        try:
            vpd.check(scene)
        except vpd.ScenarioError as error:
            refused += 1
            assert error.message and (error.pointer == "" or error.pointer.startswith("/")), scene
    assert refused > 100


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[1]", b"null", b'{"a": 1, "a": 2}', b"{" * 10_000, b'"x"'])
def test_what_is_no_scenario(text):
    with pytest.raises(vpd.ScenarioError):
        vpd.check(text)


def test_what_is_no_json(body):
    loop = {}
    loop["loop"] = loop
    for wrong in ({"x": object()}, loop, {"x": {1, 2}}, body | {"name": b"bytes"}):
        with pytest.raises(vpd.ScenarioError):
            vpd.check(wrong)
    with pytest.raises(vpd.ScenarioError) as caught:
        vpd.check(body, set={"/scene/inertia/principal/9": 1.0})
    assert caught.value.pointer


def test_the_command(tmp_path):
    """The console script is the program, with its exit codes."""
    def vpd_command(*arguments):
        return subprocess.run([sys.executable, "-m", "vpdsim", *map(str, arguments)], cwd=tmp_path, capture_output=True, text=True)

    assert vpd_command("--version").stdout.startswith("vpd ")
    assert vpd_command("run", SCENARIOS / "heavy-top.json", "--set", "/expect=null").returncode == 0
    assert (tmp_path / "heavy-top.mcap").exists()
    assert vpd_command("run", SCENARIOS / "heavy-top.json").returncode == 2
    assert vpd_command("run", "none.json").returncode == 2
    assert vpd_command("nonsense").returncode == 2
    assert vpd_command("verify", "heavy-top.mcap").returncode == 0


def test_a_script_of_a_user(tmp_path):
    """The script that the type checkers look at does what it says."""
    script = Path(__file__).with_name("user_script.py")
    done = subprocess.run([sys.executable, script], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert float(done.stdout.splitlines()[-1]) < 1e-12

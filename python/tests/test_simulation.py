"""Runs that are stepped: their log is that of a job, and says so."""

import json
import math
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from conftest import SCENARIOS

import vpdsim as vpd


def stepped(scene, log=None, steps=60, every=3):
    """A run with a torque that changes; its simulation, and the states after each step."""
    states = []
    sim = vpd.Simulation(scene, log=log)
    places = len(sim.angular_velocity)
    for k in range(steps):
        if k % every == 0:
            sim.torque = [0.01 * math.sin(k + place) for place in range(places)]
        sim.advance(steps=1)
        states.append((sim.attitude, sim.body_momentum, sim.angular_velocity))
    return sim, states


METHODS = [
    {"name": "vpd", "tableau": "gauss1"},
    {"name": "vpd", "tableau": "gauss2"},
    {"name": "vpd", "tableau": "gauss3"},
    {"name": "vpd", "tableau": "gauss6"},
    {"name": "vpd_lagrangian", "tableau": "gauss2"},
    {"name": "rkmk", "tableau": "rk4"},
]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: "-".join(method.values()))
def test_the_log_is_of_the_same_states(method, dipole, tmp_path):
    log = tmp_path / "a.mcap"
    scene = dipole | {"method": method, "log": {"every": 1}}
    sim, states = stepped(scene, log)
    assert sim.time == pytest.approx(0.6) and sim.steps == 60 and not log.exists()
    sim.close()
    run = vpd.read(log)
    assert len(run) == 61
    for k, (attitude, momentum, velocity) in enumerate(states, start=1):
        assert np.array_equal(run.attitude[k], attitude), k
        assert np.array_equal(run.body_momentum[k], momentum) and np.array_equal(run.angular_velocity[k], velocity)
    assert vpd.verify(log)["same"]
    tables = run.scenario["scene"]["torques"]
    assert len(tables) == 3 and tables[0]["table"]["table"]["interpolation"] == "hold"
    assert len(tables[0]["table"]["table"]["times_s"]) == 21
    assert np.array_equal(vpd.run(sim.scenario).attitude, run.attitude)


@pytest.mark.parametrize("name", ["heavy-top", "satellite", "so4-free", "so5-spring", "pendulum"])
def test_shipped_scenes(name, tmp_path):
    scene = json.loads((SCENARIOS / f"{name}.json").read_text())
    scene.pop("expect", None)
    scene["log"] = {"every": 1}
    sim, states = stepped(scene, tmp_path / "a.mcap")
    sim.close()
    run = vpd.read(tmp_path / "a.mcap")
    assert all(np.array_equal(run.attitude[k], state[0]) for k, state in enumerate(states, start=1))
    assert vpd.verify(tmp_path / "a.mcap")["same"]


def test_over_the_ends_of_chunks(body, tmp_path):
    """Where a chunk of the log ends, its run begins anew; so does the simulation."""
    scene = body | {"log": {"every": 1, "channels": ["/state", "/solver"]}}
    scene["scene"] = scene["scene"] | {
        "potential": [{"kind": "uniform", "weight": 1.0, "body_point": [0, 0.1, 1], "direction": [0, 0, 1]}]}
    with vpd.Simulation(scene, log=tmp_path / "a.mcap") as sim:
        sim.torque = [0.1, 0.0, 0.0]
        sim.advance(steps=4000)
        attitude = sim.attitude
    run = vpd.read(tmp_path / "a.mcap")
    assert np.array_equal(run.attitude[-1], attitude)
    assert run.plan["samples_per_chunk"] < 2000


def test_without_a_torque(dipole, tmp_path):
    with vpd.Simulation(dipole, log=tmp_path / "a.mcap") as sim:
        sim.advance(0.5)
        attitude = sim.attitude
    run = vpd.read(tmp_path / "a.mcap")
    assert np.array_equal(run.attitude[-1], attitude) and vpd.verify(tmp_path / "a.mcap")["same"]
    # Next to a run without torques there is rounding alone.
    assert np.allclose(vpd.run(dipole, set={"/steps": 50}).attitude[-1], attitude, atol=1e-12)


def test_a_torque_turns_the_body(body):
    body["scene"]["initial"] = {}
    sim = vpd.Simulation(body)
    sim.torque = np.array([0.0, 0.0, 0.3])
    sim.advance(1.0)
    assert sim.angular_velocity == pytest.approx([0, 0, 0.1]) and list(sim.torque) == [0, 0, 0.3]
    angle = 0.05
    turned = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    assert np.allclose(sim.attitude, turned, atol=1e-12)
    before = sim.attitude
    sim.advance(1.0)
    assert not np.array_equal(before, sim.attitude)


def test_a_controller(body, tmp_path):
    """A function in place of the loop: the same log."""
    def damping(time, attitude, velocity):
        assert attitude.shape == (3, 3) and time >= 0
        return -0.5 * velocity

    with vpd.Simulation(body, log=tmp_path / "a.mcap", torque=damping) as sim:
        sim.advance(1.0)
    with vpd.Simulation(body, log=tmp_path / "b.mcap") as sim:
        for _ in range(100):
            sim.torque = -0.5 * sim.angular_velocity
            sim.advance()
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    run = vpd.read(tmp_path / "a.mcap")
    assert np.linalg.norm(run.angular_velocity[-1]) < 0.9 * np.linalg.norm(run.angular_velocity[0])


def test_a_controller_that_raises(body, tmp_path):
    def broken(time, attitude, velocity):
        if time > 0.305:
            raise LookupError("no star in sight")
        return [0.1, 0, 0]

    with pytest.raises(LookupError, match="no star"), vpd.Simulation(body, log=tmp_path / "a.mcap", torque=broken) as sim:
        sim.advance(1.0)
    assert sim.steps == 31
    run = vpd.read(tmp_path / "a.mcap")
    assert run.time[-1] == pytest.approx(0.31) and run.outcome["outcome"] == "succeeded"
    assert vpd.verify(tmp_path / "a.mcap")["same"]


def test_a_step_that_fails(dipole, tmp_path):
    with pytest.raises(vpd.RunFailed) as caught, \
            vpd.Simulation(dipole, set={"/step_s": 5.0}, log=tmp_path / "a.mcap") as sim:
        sim.advance(steps=1000)
    assert caught.value.step == sim.steps + 1
    run = vpd.read(tmp_path / "a.mcap")
    assert run.outcome["outcome"] == "failed" and run.outcome["code"] == caught.value.code
    assert vpd.verify(tmp_path / "a.mcap")["same"]


def test_what_is_refused(body, dipole, tmp_path):
    sim = vpd.Simulation(body)
    with pytest.raises(ValueError, match="not a whole number of steps"):
        sim.advance(0.015)
    with pytest.raises(ValueError):
        sim.advance(-0.01)
    with pytest.raises(ValueError):
        sim.advance(float("nan"))
    for wrong in ([1, 2], [1, 2, 3, 4], [0, 0, float("nan")], [0, 0, 1e300]):
        with pytest.raises(ValueError):
            sim.torque = wrong
    with pytest.raises(TypeError):
        sim.torque = "none"
    with pytest.raises(TypeError, match="a list or an array of 3 numbers"):
        sim.torque = 5
    for wrong in (lambda: sim.wheel_torque, lambda: setattr(sim, "wheel_torque", [0, 0, 1])):
        with pytest.raises(vpd.Error, match="wheels"):
            wrong()
    sim.close()
    with pytest.raises(RuntimeError, match="closed"):
        sim.advance(0.01)
    (tmp_path / "a.mcap").write_text("mine")
    with pytest.raises(vpd.Error, match="already exists"):
        vpd.Simulation(body, log=tmp_path / "a.mcap")
    adaptive = json.loads((SCENARIOS / "flyby.json").read_text())
    with pytest.raises(vpd.ScenarioError):
        vpd.Simulation(adaptive)
    with pytest.raises(vpd.ScenarioError, match="ensemble"):
        vpd.Simulation(SCENARIOS / "satellite-ensemble.json")


def test_without_a_step_there_is_no_log(body, tmp_path):
    with vpd.Simulation(body, log=tmp_path / "a.mcap") as sim:
        sim.torque = [0, 0, 1]
    assert not list(tmp_path.iterdir())
    with pytest.raises(vpd.ScenarioError, match="/steps"):
        sim.scenario


def test_others_go_on_meanwhile(body):
    sim = vpd.Simulation(body)
    thread = threading.Thread(target=lambda: sim.advance(steps=2_000_000))
    thread.start()
    rounds = 0
    while thread.is_alive():
        rounds += 1
        thread.join(0.001)
    assert rounds > 1 and sim.steps == 2_000_000


def test_ctrl_c(body, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(body))
    program = (
        "import vpdsim as vpd\n"
        "with vpd.Simulation('a.json', log='a.mcap') as sim:\n"
        "    sim.advance(steps=10)\n"
        "    try:\n"
        "        print('begun', flush=True)\n"
        "        sim.advance(steps=10**12)\n"
        "    except KeyboardInterrupt:\n"
        "        print('stopped', flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "begun\n"
    os.kill(process.pid, signal.SIGINT)
    assert "stopped" in process.communicate(timeout=300)[0]
    assert vpd.read(tmp_path / "a.mcap").outcome["outcome"] == "succeeded"

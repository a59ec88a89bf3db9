"""Runs, logs and what is said of them: the same as the command line, to the byte and the bit."""

import json
import pickle
import threading
import time

import numpy as np
import pytest
from conftest import SCENARIOS

import vpdsim as vpd

SHIPPED = ["chain", "detumble", "dipole", "cubesat", "dual-spin", "flyby", "free-body", "heavy-top", "nutation-damper", "pendulum", "satellite", "slew", "so4-free", "so5-spring", "tether"]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_log_is_that_of_the_command_line(name, command, tmp_path):
    scene = json.loads((SCENARIOS / f"{name}.json").read_text())
    file = tmp_path / f"{name}.json"
    file.write_text(json.dumps(scene))
    short = {"/steps": None, "/duration_s": None, "/expect": None}
    step_s = vpd.plan(file)["step_s"]
    short |= {"/steps": 300} if "step_s" in scene else {"/duration_s": 100 * step_s}
    run = vpd.run(file, log=tmp_path / "python.mcap", set=short)
    changes = [f"--set={pointer}={json.dumps(value)}" for pointer, value in short.items()]
    command("run", file, "-o", tmp_path / "command.mcap", *changes)
    assert (tmp_path / "python.mcap").read_bytes() == (tmp_path / "command.mcap").read_bytes()
    # In memory, without a log, and read from it: the same arrays.
    for other in (vpd.run(file, set=short), vpd.read(tmp_path / "python.mcap")):
        assert list(other.columns) == list(run.columns)
        for column, values in run.columns.items():
            assert np.array_equal(values, other.columns[column], equal_nan=values.dtype.kind == "f"), column
    assert vpd.verify(tmp_path / "python.mcap")["same"]


@pytest.mark.parametrize("name", ["dipole", "heavy-top", "satellite", "so4-free", "flyby", "slew", "detumble", "chain", "tether"])
def test_arrays_are_those_of_an_export(name, command, tmp_path):
    pandas = pytest.importorskip("pandas")
    log = tmp_path / "a.mcap"
    run = vpd.run(SCENARIOS / f"{name}.json", log=log, set={"/expect": None})
    command("export", log, "-o", tmp_path / "a.csv")
    command("export", log, "-o", tmp_path / "a.npz")
    table = pandas.read_csv(tmp_path / "a.csv", keep_default_na=False, na_values=[""])
    frame = run.to_pandas()
    assert set(frame.columns) == set(table.columns)
    for column in table.columns:
        ours, theirs = frame[column].to_numpy(), table[column].to_numpy()
        if ours.dtype.kind in "US" or ours.dtype == object:
            ours, theirs = ours[1:], theirs[1:]
            assert list(ours) == list(theirs)
        elif ours.dtype.kind == "u" and theirs.dtype.kind == "f":
            # The start has no step: empty there, and 0 here.
            assert np.array_equal(ours, np.nan_to_num(theirs).astype(np.uint64)), column
        elif ours.dtype.kind == "u":
            assert np.array_equal(ours, theirs.astype(np.uint64)), column
        else:
            assert np.array_equal(ours, theirs.astype(float), equal_nan=True), column
    with np.load(tmp_path / "a.npz") as arrays:
        assert set(arrays.files) == set(run.columns)
        for column in arrays.files:
            values = run.columns[column]
            assert arrays[column].shape == values.shape
            assert np.array_equal(arrays[column], values, equal_nan=values.dtype.kind == "f"), column
    run.to_npz(tmp_path / "ours.npz")
    with np.load(tmp_path / "ours.npz") as arrays:
        assert set(arrays.files) == set(run.columns)


def test_shapes(dipole):
    run = vpd.run(dipole)
    assert len(run) == 11 and run.time[-1] == pytest.approx(1)
    assert run.attitude.shape == (11, 3, 3) and run.quaternion.shape == (11, 4)
    assert run.angular_velocity.shape == run.body_momentum.shape == run.momentum.spatial.shape == (11, 3)
    assert run.energy.error.shape == run.orthogonality_error.shape == run.solver.iterations.shape == (11,)
    assert run.solver.iterations[0] == 0 and run.solver.rung[0] == "" and run.solver.rung[1] == "fixed_point"
    assert np.allclose(np.einsum("kij,klj->kil", run.attitude, run.attitude), np.eye(3), atol=1e-14)
    assert run.outcome["outcome"] == "succeeded" and run.plan["steps"] == 100
    assert run.final["attitude"] == run.attitude[-1].tolist()
    assert run.scenario["name"] == "dipole"
    for values in run.columns.values():
        assert values.flags.c_contiguous and values.flags.writeable
    so4 = vpd.run(SCENARIOS / "so4-free.json", set={"/duration_s": None, "/steps": 10, "/expect": None})
    assert so4.attitude.shape[1:] == (4, 4) and so4.angular_velocity.shape[1:] == (6,)
    with pytest.raises(vpd.Absent, match="quaternion"):
        so4.quaternion


def test_what_was_not_logged_is_absent(dipole):
    run = vpd.run(dipole, set={"/log/channels": ["/energy"]})
    assert not hasattr(run, "attitude") and not hasattr(run.momentum, "drift")
    assert dir(run.energy) == ["error", "kinetic", "potential", "total"]
    with pytest.raises(vpd.Error, match="/state"):
        run.attitude
    with pytest.raises(AttributeError):
        run.energy.colour


def test_a_scene_is_a_path_or_text_or_a_dict(dipole, tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(dipole))
    numpy = dipole | {"step_s": np.float64(0.01), "steps": np.int64(100)}
    numpy["scene"] = dipole["scene"] | {"inertia": {"principal": np.array([1.01, 1.0, 0.01])}}
    runs = [vpd.run(scene) for scene in (tmp_path / "a.json", str(tmp_path / "a.json"), json.dumps(dipole),
                                         json.dumps(dipole).encode(), dipole, numpy)]
    for run in runs:
        assert np.array_equal(run.attitude, runs[0].attitude)
    with pytest.raises(FileNotFoundError):
        vpd.run(tmp_path / "none.json")
    with pytest.raises(TypeError):
        vpd.run(3)


def test_the_plan_is_that_of_the_command_line(command):
    ours = vpd.plan(SCENARIOS / "heavy-top.json")
    theirs = json.loads(command("plan", SCENARIOS / "heavy-top.json", "--json").stdout)
    # These are timed.
    for timed in ("step_ns", "run_s"):
        del ours[timed], theirs[timed]
    assert ours == theirs


def test_an_accuracy(body):
    del body["step_s"], body["steps"]
    body |= {"accuracy": {"error": 1e-8}, "duration_s": 1}
    vpd.check(body)
    run = vpd.run(body)
    assert run.plan["advice"]["expected_error"] < 1e-8 and run.time[-1] == 1


def test_an_ensemble(tmp_path):
    scene = json.loads((SCENARIOS / "satellite-ensemble.json").read_text())
    scene.pop("expect", None)
    scene["ensemble"] = scene["ensemble"] | {"members": 5, "in_full": [3]}
    scene["duration_s"] = 100 * scene["step_s"]
    run = vpd.run(scene)
    assert run.outcome["ensemble"]["succeeded"] == 5
    member = run.member(3)
    assert member.attitude.shape == run.attitude.shape and not np.array_equal(member.attitude, run.attitude)
    with pytest.raises(vpd.Error, match="member 2"):
        run.member(2)


def test_a_run_that_fails(dipole):
    with pytest.raises(vpd.RunFailed) as caught:
        vpd.run(dipole, set={"/step_s": 5.0, "/steps": 1000})
    error = caught.value
    assert error.code and error.step >= 1 and error.cause and error.advice
    assert error.code in str(error) and error.run.outcome["outcome"] == "failed"
    assert error.diagnosis["advised_step_s"] is None or error.diagnosis["advised_step_s"] < 5
    again = pickle.loads(pickle.dumps(error))
    assert (again.code, again.step, str(again)) == (error.code, error.step, str(error))


def test_a_log_in_the_way(dipole, tmp_path):
    log = tmp_path / "a.mcap"
    vpd.run(dipole, log=log)
    with pytest.raises(vpd.Error, match="already exists"):
        vpd.run(dipole, log=log)
    vpd.run(dipole, log=log, set={"/steps": 50}, force=True)
    assert vpd.read(log).time[-1] == 0.5


def test_what_is_no_log(tmp_path):
    (tmp_path / "a.mcap").write_text("no log")
    for path in (tmp_path / "a.mcap", tmp_path / "none.mcap"):
        with pytest.raises(vpd.Error):
            vpd.read(path)
        with pytest.raises(vpd.Error):
            vpd.verify(path)


def test_progress(dipole):
    seen = []
    vpd.run(dipole, set={"/steps": 1_000_000, "/log/every": 1000}, progress=lambda done, whole: seen.append((done, whole)))
    assert seen[-1] == (1_000_000, 1_000_000) and seen == sorted(seen) and len(seen) > 1
    with pytest.raises(ZeroDivisionError):
        vpd.run(dipole, set={"/steps": 100_000_000}, progress=lambda done, whole: 1 / 0)


def test_threads_run_at_once(dipole):
    """While two runs are under way, this thread goes on, and both give what one alone gives."""
    alone = vpd.run(dipole, set={"/steps": 300_000})
    runs = [None, None]

    def work(at):
        runs[at] = vpd.run(dipole, set={"/steps": 300_000})

    threads = [threading.Thread(target=work, args=[at]) for at in range(2)]
    for thread in threads:
        thread.start()
    rounds = 0
    while any(thread.is_alive() for thread in threads):
        rounds += 1
        time.sleep(0.001)
    assert rounds > 1
    for run in runs:
        assert np.array_equal(run.attitude, alone.attitude)


def test_ctrl_c_and_the_log_goes_on(command, dipole, tmp_path):
    """In a process of its own: an interrupt ends the run, and the same call resumes the log."""
    import os
    import signal
    import subprocess
    import sys

    scene = dipole | {"steps": 3_000_000, "log": {"every": 10}}
    (tmp_path / "a.json").write_text(json.dumps(scene))
    program = (
        "import vpdsim as vpd, signal, sys\n"
        # A process in the background of a shell ignores it.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def told(done, whole):\n"
        "    if done > 400_000: print('far', flush=True)\n"
        "try:\n"
        "    vpd.run('a.json', log='a.mcap', progress=told)\n"
        "except KeyboardInterrupt:\n"
        "    print('stopped', flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "far\n"
    os.kill(process.pid, signal.SIGINT)
    assert "stopped" in process.communicate(timeout=60)[0]
    assert (tmp_path / "a.mcap.part").exists() and not (tmp_path / "a.mcap").exists()
    assert len(vpd.read(tmp_path / "a.mcap.part")) > 1 and vpd.read(tmp_path / "a.mcap.part").damage
    run = vpd.run(tmp_path / "a.json", log=tmp_path / "a.mcap")
    assert run.outcome["resumed_step"] > 0 and len(run) == 300_001
    command("run", tmp_path / "a.json", "-o", tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_diff(dipole, tmp_path):
    a = vpd.run(dipole, log=tmp_path / "a.mcap")
    b = vpd.run(dipole, log=tmp_path / "b.mcap", set={"/method/tableau": "gauss1"})
    found = vpd.diff(a, b, tolerance={"angle": 1e-9})
    assert not found["agree"] and found["samples"] == 11 and len(found["over_time"]) == 11
    assert vpd.diff(a, tmp_path / "b.mcap", tolerance=10.0)["agree"]
    assert vpd.diff(a, a)["agree"]
    with pytest.raises(vpd.Error, match="no log"):
        vpd.diff(vpd.run(dipole), a)
    with pytest.raises(vpd.Error):
        vpd.diff(a, b, tolerance={"colour": 1.0})


def test_fit(command, dipole, tmp_path):
    fields = ["/scene/inertia/principal/2", "/scene/potential/1/strength"]
    seen = vpd.run(dipole, log=tmp_path / "seen.mcap")
    off = {field: 1.02 * value for field, value in zip(fields, _at(dipole, fields))}
    found = vpd.fit(dipole, seen, fields, set=off)
    for one, truth in zip(found["fitted"], _at(dipole, fields)):
        assert one["before"] == off[one["field"]] and abs(one["value"] / truth - 1) < 1e-9
    assert found["after_rad"] < 1e-9 < found["before_rad"] and len(found["covariance"]) == 2
    assert _at(found["scenario"], fields) == [one["value"] for one in found["fitted"]]
    assert len(vpd.run(found["scenario"])) == len(seen)
    # A table has the same attitudes; the residuals, and so the standard errors, are rounding.
    command("export", tmp_path / "seen.mcap", "-o", tmp_path / "seen.csv")
    by_table = vpd.fit(dipole, tmp_path / "seen.csv", fields, set=off)["fitted"]
    for one, other in zip(found["fitted"], by_table):
        assert one["field"] == other["field"] and abs(one["value"] / other["value"] - 1) < 1e-12
    with pytest.raises(vpd.ScenarioError) as caught:
        vpd.fit(dipole, seen, ["/step_s"])
    assert "/step_s" in caught.value.message
    with pytest.raises(vpd.Error, match="no log"):
        vpd.fit(dipole, vpd.run(dipole), fields)


def _at(scene, pointers):
    def value(tree, pointer):
        for key in pointer.split("/")[1:]:
            tree = tree[int(key) if isinstance(tree, list) else key]
        return tree

    return [value(scene, pointer) for pointer in pointers]


def test_a_sweep_is_that_of_the_command_line(command, dipole, tmp_path):
    sweep = {
        "scenario": dipole,
        "vary": [{"pointer": "/scene/inertia/principal/2", "values": {"linear": {"from": 0.01, "to": 0.1, "count": 5}}}],
        "keep_logs": [2],
    }
    (tmp_path / "sweep.json").write_text(json.dumps(sweep))
    command("sweep", tmp_path / "sweep.json", "-o", tmp_path / "command.csv")
    seen = []
    made = vpd.sweep(tmp_path / "sweep.json", out=tmp_path / "file.csv", progress=lambda *count: seen.append(count))
    assert made["succeeded"] == 5 and seen[-1] == (5, 5)
    vpd.sweep(sweep, out=tmp_path / "dict.csv", threads=1)
    tables = [(tmp_path / f"{name}.csv").read_bytes() for name in ("command", "file", "dict")]
    assert tables[0] == tables[1] == tables[2]
    assert vpd.verify(tmp_path / "file.logs" / "2.mcap")["same"]
    with pytest.raises(vpd.Error, match="already exists"):
        vpd.sweep(sweep, out=tmp_path / "dict.csv")
    with pytest.raises(vpd.ScenarioError) as caught:
        vpd.sweep(sweep | {"vary": []}, out=tmp_path / "none.csv")
    assert caught.value.pointer.startswith("/vary")


def test_charts_and_what_a_notebook_shows(dipole):
    run = vpd.run(dipole)
    for which in ("energy", "orthogonality", "momentum"):
        chart = run.chart(which)
        assert chart.startswith("<svg") and chart._repr_svg_() == chart
    assert "<svg" in run._repr_html_() and "dipole" in run._repr_html_() and "dipole" in repr(run)
    with pytest.raises(vpd.Error, match="no chart"):
        run.chart("colour")
    with pytest.raises(vpd.Absent):
        run.chart("pace")


def test_tables_of_arrow(dipole):
    pyarrow, polars = pytest.importorskip("pyarrow"), pytest.importorskip("polars")
    import gc

    from vpdsim import _arrow

    run = vpd.run(dipole)
    table = pyarrow.table(run)
    assert table.num_rows == len(run) and table.column_names == list(run.columns)
    frame = polars.DataFrame(run)
    for found in (table["energy_error"].to_numpy(), frame["energy_error"].to_numpy()):
        assert np.array_equal(found, run.energy.error)
    attitude = table["attitude"].chunk(0)
    assert np.array_equal(np.array(attitude.values).reshape(-1, 3, 3), run.attitude)
    # Not a copy: the same place in memory.
    assert attitude.values.buffers()[1].address == run.attitude.ctypes.data
    assert table["solver_rung"].to_pylist() == run.solver.rung.tolist()
    assert table["solver_increment"].null_count == 1
    del table, frame, found, attitude
    gc.collect()
    assert not _arrow.kept and not _arrow.places
    # One that nobody takes is released, too.
    run.__arrow_c_stream__()
    gc.collect()
    assert not _arrow.kept and not _arrow.places


def test_the_version_of_the_format(dipole):
    assert np.array_equal(vpd.run(dipole | {"format": 1}).attitude, vpd.run(dipole).attitude)
    with pytest.raises(vpd.ScenarioError) as caught:
        vpd.check(dipole | {"format": 2})
    assert caught.value.pointer == "/format" and "newer" in caught.value.message
    assert vpd.schema()["properties"]["format"]["const"] == 1
    assert "vary" in vpd.schema("sweep")["properties"]


def test_derivatives(dipole):
    parameters = ["/scene/inertia/principal/2", "/scene/potential/1/strength"]
    run = vpd.run(dipole | {"derivatives": {"state": True, "parameters": parameters}})
    samples = len(run)
    assert run.transition.shape == (samples, 6, 6)
    assert run.sensitivity.shape == (samples, 2, 6)
    assert np.array_equal(run.transition[0], np.eye(6))
    assert run.outcome["derivatives"]["symplectic_error"] < 1e-12
    assert "transition_1_2" in run.to_pandas() and "sensitivity_12" in run.to_pandas()
    covariance = {"attitude_spread_rad": 0.01, "parameter_spreads": [0.1, 0]}
    run = vpd.run(dipole | {"derivatives": {"state": True, "parameters": parameters, "covariance": covariance}})
    start, moved = np.diag([1e-4] * 3 + [0] * 3), run.sensitivity[-1][0]
    expected = run.transition[-1] @ start @ run.transition[-1].T + 0.01 * np.outer(moved, moved)
    assert np.allclose(run.covariance[-1], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert np.allclose(run.covariance[0][:3, :3], start[:3, :3])
    assert run.outcome["covariance"]["attitude_spread_rad"] > 0
    assert "covariance_6_6" in run.to_pandas()

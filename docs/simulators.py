"""vpd next to the simulators that people use: the same scenes on the same machine, error against known answers, and time.

    python3 -m venv venv && venv/bin/pip install mujoco==4.0.0 drake==1.51.0 bsk==2.12.1
    venv/bin/python docs/simulators.py target/release/vpd docs/simulators.svg
    python3 -m venv old && old/bin/pip install mujoco==3.3.7
    old/bin/python docs/simulators.py target/release/vpd

It prints a table for each scene, of the simulators that are installed next to it, and draws how the energy of a tumbling body
behaves in each of them, if a file for the picture is given.

Each carries one body from a given state to a time at which its attitude is known, by several steps. The error is the angle between the
attitude reached and the known one, in radians. The time is that of a step, the least of fifteen runs with the fewest steps: of MuJoCo that
of one call of mj_step with all steps, in C, contacts and constraints switched off; of Basilisk and Drake that of their own loop over
all steps, with what they do in each besides; of vpd what it reports of its integrator, with a sample at both ends.
"""

import importlib.metadata
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def installed(package, module):
    """The module of a simulator and its version; nothing where it is not installed."""
    try:
        return importlib.import_module(module), importlib.metadata.version(package)
    except ImportError:
        return None, None


mujoco, MUJOCO = installed("mujoco", "mujoco")
drake, DRAKE = installed("drake", "pydrake.all")
basilisk, BASILISK = installed("bsk", "Basilisk.simulation.spacecraft")

REPEATS = 15

# Attitudes are quaternions w, x, y, z; moments are about the fixed point. The answers are those of docs/cross-checks.md.
SCENES = {
    "a body that turns over": dict(
        mass=1.0, centre=[0, 0, 0], gravity=0.0, moments=[1.0, 2.0, 3.0], omega=[0.01, 1.0, 0.0],
        seconds=41.5092195293385, known=[-0.653684370304628, -0.003783789195234, -0.75675783904679, 0.0],
        steps=[500, 5000, 50000],
    ),
    "fast heavy top": dict(
        mass=15.0, centre=[0, 1, 0], gravity=9.81, moments=[15.234375, 0.46875, 15.234375], omega=[0.0, 150.0, -4.61538],
        seconds=2.0, known=[0.122947135041533, -0.491079892550027, 0.350430030343621, -0.787986887550486],
        steps=[500, 5000, 50000],
    ),
    "damped body": dict(
        mass=1.0, centre=[0, 0, 0], gravity=0.0, moments=[1.0, 2.0, 3.0], omega=[0.01, 1.0, 0.0], damping=0.1,
        seconds=10.0, known=None, steps=[100, 1000, 10000],
    ),
}

OURS = [
    ("vpd, `vpd` gauss2", {"name": "vpd", "tableau": "gauss2"}),
    ("vpd, `vpd` gauss4", {"name": "vpd", "tableau": "gauss4"}),
    ("vpd, `rk_projected` rk4", {"name": "rk_projected", "tableau": "rk4"}),
]
THEIRS = ["Euler", "implicitfast", "implicit", "RK4"]


def angle(a, b):
    """Between two attitudes; of small angles by the vector part, which loses no digits."""
    w = sum(x * y for x, y in zip(a, b))
    vector = [
        a[0] * b[i] - b[0] * a[i] - (a[j] * b[k] - a[k] * b[j])
        for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2))
    ]
    return 2 * math.atan2(math.hypot(*vector), abs(w))


def quaternion(rows):
    """Of a rotation matrix, by its largest component."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    found = [
        [squares[0], h - f, c - g, d - b],
        [h - f, squares[1], b + d, c + g],
        [c - g, b + d, squares[2], f + h],
        [d - b, c + g, f + h, squares[3]],
    ][squares.index(max(squares))]
    size = math.hypot(*found)
    return [x / size for x in found]


def mujoco_model(scene, integrator, step):
    """MuJoCo wants moments about the centre of mass: Huygens and Steiner."""
    centre, mass = scene["centre"], scene["mass"]
    square = sum(x * x for x in centre)
    moments = [J - mass * (square - x * x) for J, x in zip(scene["moments"], centre)]
    text = f"""<mujoco>
  <compiler boundinertia="0" boundmass="0"/>
  <option timestep="{step!r}" gravity="0 0 {-scene["gravity"]!r}" integrator="{integrator}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody><body>
    <joint type="ball" damping="{scene.get("damping", 0.0)!r}"/>
    <inertial pos="{" ".join(map(str, centre))}" mass="{mass}" diaginertia="{" ".join(map(repr, moments))}"/>
  </body></worldbody>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def with_mujoco(scene, integrator, steps, repeats):
    model = mujoco_model(scene, integrator, scene["seconds"] / steps)
    best, found = math.inf, None
    for _ in range(repeats):
        data = mujoco.MjData(model)
        data.qvel[:] = scene["omega"]
        begun = time.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        best = min(best, time.perf_counter() - begun)
        # It begins anew, and goes on, where numbers are none any more.
        if any(warning.number for warning in data.warning):
            return None, None
        found = list(data.qpos)
    return found, best / steps


def with_vpd(program, scene, method, steps, repeats):
    body = {
        "inertia": {"principal": scene["moments"]},
        "initial": {"angular_velocity": {"body": scene["omega"]}},
    }
    if scene["gravity"]:
        weight = scene["mass"] * scene["gravity"]
        body["potential"] = [{"kind": "uniform", "weight": weight, "body_point": scene["centre"], "direction": [0, 0, 1]}]
    if "damping" in scene:
        body["torques"] = [{"viscous": {"coefficient": scene["damping"]}}]
    scenario = {
        "name": "compared", "scene": body, "method": method, "step_s": scene["seconds"] / steps, "steps": steps,
        "log": {"every": steps, "channels": ["/state"]},
    }
    best, found = math.inf, None
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "compared.json"
            path.write_text(json.dumps(scenario))
            run = subprocess.run(
                [program, "run", path, "--json", "-o", Path(folder) / "compared.mcap"], capture_output=True, text=True
            )
        summary = json.loads(run.stdout)
        if summary["outcome"] != "succeeded":
            return None, None
        best = min(best, summary["ns_per_step"] * 1e-9)
        found = quaternion(summary["final"]["attitude"])
    return found, best


def with_basilisk(scene, integrator, steps, repeats, watch=None):
    """A free body as the hub of a spacecraft. Its clock counts nanoseconds, so its steps are rounded to these."""
    from Basilisk.simulation import svIntegrators
    from Basilisk.utilities import SimulationBaseClass

    step_ns = round(1e9 * scene["seconds"] / steps)
    best, found = math.inf, None
    for _ in range(repeats):
        simulation = SimulationBaseClass.SimBaseClass()
        simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", step_ns))
        body = basilisk.Spacecraft()
        body.hub.mHub = scene["mass"]
        body.hub.r_BcB_B = [[0.0], [0.0], [0.0]]
        body.hub.IHubPntBc_B = [[J if i == j else 0.0 for j in range(3)] for i, J in enumerate(scene["moments"])]
        body.hub.sigma_BNInit = [[0.0], [0.0], [0.0]]
        body.hub.omega_BN_BInit = [[w] for w in scene["omega"]]
        method = getattr(svIntegrators, f"svIntegrator{integrator}")(body)
        body.setIntegrator(method)
        simulation.AddModelToTask("task", body)
        simulation.InitializeSimulation()
        simulation.ConfigureStopTime(0)
        simulation.ExecuteSimulation()
        begun = time.perf_counter()
        stops = [steps] if watch is None else range(watch[0], steps + 1, watch[0])
        for stop in stops:
            simulation.ConfigureStopTime(stop * step_ns)
            simulation.ExecuteSimulation()
            state = body.scStateOutMsg.read()
            if watch:
                watch[1](stop * step_ns * 1e-9, list(state.omega_BN_B))
        best = min(best, time.perf_counter() - begun)
        # Modified Rodrigues parameters, of the turn from space to body.
        s = state.sigma_BN
        square = sum(x * x for x in s)
        found = [(1 - square) / (1 + square), *(2 * x / (1 + square) for x in s)]
    return found, best / steps, steps * step_ns * 1e-9


def with_drake(scene, integrator, steps, repeats, watch=None):
    """A free body; `discrete` is a plant with a time step, anything else an integrator with fixed steps."""
    step = scene["seconds"] / steps
    best, found = math.inf, None
    for _ in range(repeats):
        plant = drake.MultibodyPlant(step if integrator == "discrete" else 0.0)
        unit = drake.UnitInertia(*(J / scene["mass"] for J in scene["moments"]))
        body = plant.AddRigidBody("body", drake.SpatialInertia(scene["mass"], [0, 0, 0], unit))
        plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
        plant.Finalize()
        simulator = drake.Simulator(plant)
        context = simulator.get_mutable_context()
        velocity = drake.SpatialVelocity(scene["omega"], [0, 0, 0])
        plant.SetFreeBodySpatialVelocity(context=context, body=body, V_JpJc=velocity)
        if integrator != "discrete":
            drake.ResetIntegratorFromFlags(simulator, integrator, step)
            simulator.get_mutable_integrator().set_fixed_step_mode(True)
        simulator.Initialize()

        def state():
            """Attitude and angular velocity in the body, of a quaternion of whatever length."""
            q = plant.GetPositions(context)[:4]
            q = q / math.hypot(*q)
            w = plant.EvalBodySpatialVelocityInWorld(context, body).rotational()
            turn = drake.RotationMatrix(drake.Quaternion(q)).matrix()
            return list(q), list(turn.T @ w)

        begun = time.perf_counter()
        stops = [steps] if watch is None else range(watch[0], steps + 1, watch[0])
        for stop in stops:
            simulator.AdvanceTo(stop * step)
            if watch:
                watch[1](stop * step, state()[1])
        best = min(best, time.perf_counter() - begun)
        found = state()[0]
    return found, best / steps


# ---- the energy of a tumbling body

TUMBLING = dict(SCENES["a body that turns over"], seconds=1000.0)
# Long enough for each to show what it does: 63 steps in a turn.
STEP_S, SAMPLES = 0.1, 500


def energies(run, steps):
    """The relative errors of the kinetic energy over time that a run shows."""
    J = TUMBLING["moments"]
    kinetic = lambda w: 0.5 * sum(j * x * x for j, x in zip(J, w))
    first, found = kinetic(TUMBLING["omega"]), []
    see = lambda t, w: found.append((t, abs(kinetic(w) / first - 1)))
    run((steps // SAMPLES, see))
    return found


def mujoco_energies(integrator, steps):
    def run(watch):
        every, see = watch
        model = mujoco_model(TUMBLING, integrator, TUMBLING["seconds"] / steps)
        data = mujoco.MjData(model)
        data.qvel[:] = TUMBLING["omega"]
        for _ in range(SAMPLES):
            mujoco.mj_step(model, data, nstep=every)
            # It begins anew where numbers are none any more.
            lost = any(warning.number for warning in data.warning)
            see(data.time, [math.nan] * 3 if lost else list(data.qvel))

    return energies(run, steps)


def vpd_energies(program, method, steps):
    """The same from the table of a log."""
    scenario = {
        "name": "tumbling", "method": method, "step_s": TUMBLING["seconds"] / steps, "steps": steps,
        "scene": {"inertia": {"principal": TUMBLING["moments"]}, "initial": {"angular_velocity": {"body": TUMBLING["omega"]}}},
        "log": {"every": steps // SAMPLES},
    }
    with tempfile.TemporaryDirectory() as folder:
        path, log, table = (Path(folder) / name for name in ("tumbling.json", "tumbling.mcap", "tumbling.csv"))
        path.write_text(json.dumps(scenario))
        subprocess.run([program, "run", path, "-o", log], capture_output=True, check=True)
        subprocess.run([program, "export", log, "-o", table], capture_output=True, check=True)
        head, *rows = (line.split(",") for line in table.read_text().splitlines())
    at = [head.index(name) for name in ("time_s", *(f"angular_velocity_{axis}" for axis in "xyz"))]
    values = [[float(row[k]) for k in at] for row in rows[1:]]

    def all_rows(watch):
        for t, *w in values:
            watch[1](t, w)

    return energies(all_rows, steps)


def tumbling(program):
    """The curve of each program, as it is by default and by what it has of higher order."""
    steps = round(TUMBLING["seconds"] / STEP_S)
    runs = {}
    if mujoco:
        for kind, word in (("Euler", "the default"), ("RK4", "")):
            runs[f"MuJoCo {MUJOCO} {kind}", word] = lambda n, kind=kind: mujoco_energies(kind, n)
    if drake:
        for kind, word in (("discrete", "a plant with a time step"), ("runge_kutta3", "the default without one")):
            runs[f"Drake {DRAKE} {kind}", word] = lambda n, kind=kind: energies(
                lambda watch: with_drake(TUMBLING, kind, n, 1, watch), n)
    if basilisk:
        for kind, word in (("RK4", "the default"),):
            runs[f"Basilisk {BASILISK} {kind}", word] = lambda n, kind=kind: energies(
                lambda watch: with_basilisk(TUMBLING, kind, n, 1, watch), n)
    for tableau in ("gauss2", "gauss4"):
        runs[f"vpd {tableau}", ""] = lambda n, tableau=tableau: vpd_energies(program, {"name": "vpd", "tableau": tableau}, n)
    found = {}
    print(f"| a tumbling body for 1000 s | largest energy error of the last 100 s, steps of {STEP_S} s | steps of {STEP_S / 10} s |")
    print("|---|---|---|")
    for (name, word), run in runs.items():
        curve, fine = run(steps), run(10 * steps)
        last = lambda curve: max(e for _, e in curve[-SAMPLES // 10 :])
        end = lambda curve: f"{last(curve):.0e}" if all(math.isfinite(e) for _, e in curve) else "fails"
        print(f"| {name}{f' ({word})' if word else ''} | {end(curve)} | {end(fine)} |", flush=True)
        found[name] = curve
    print()
    return found


# Colours of Okabe and Ito, and dashes, so that no line needs its colour.
INKS = ("#d55e00", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#0072b2", "#000000")
DASHES = ("8 4", "", "3 3", "14 4", "14 4 3 4", "", "2 2")


def draw(curves, path):
    """The curves on a logarithmic axis, as SVG; what is below 1e-16 stands at its end."""
    wide, high, left, top, right, below = 960, 420, 90, 50, 250, 50
    lowest, highest = -16.0, 1.0
    place_x = lambda t: left + t / TUMBLING["seconds"] * (wide - left - right)
    place_y = lambda e: top + (highest - min(highest, math.log10(max(e, 1e-16)))) / (highest - lowest) * (high - top - below)
    text = lambda x, y, words, more="": f'<text x="{x:.0f}" y="{y:.0f}" font-size="14" {more}>{words}</text>'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}" height="{high}" font-family="sans-serif" fill="#282828">',
        f'<rect width="{wide}" height="{high}" fill="#fff"/>',
        text(20, 26, f"Energy error of a tumbling body over 1000 s, in parts of its energy; every program with steps of {STEP_S} s", 'font-weight="600"'),
    ]
    for decade in range(-16, 2, 4):
        y = place_y(10.0**decade)
        parts.append(f'<path d="M{left} {y:.0f}H{wide - right}" stroke="#e1e1e1"/>')
        parts.append(text(left - 8, y + 5, f"1e{decade}" if decade else "1", 'text-anchor="end"'))
    for t in range(0, 1001, 200):
        parts.append(text(place_x(t), high - below + 20, t, 'text-anchor="middle"'))
    parts.append(text((left + wide - right) / 2, high - 10, "time in s", 'text-anchor="middle"'))
    for k, (name, curve) in enumerate(curves.items()):
        look = f'stroke="{INKS[k % len(INKS)]}" stroke-width="2" fill="none" stroke-dasharray="{DASHES[k % len(DASHES)]}"'
        ends = [(t, e) for t, e in curve if math.isfinite(e)]
        points = " ".join(f"{place_x(t):.1f},{place_y(e):.1f}" for t, e in ends)
        parts.append(f'<polyline points="{points}" {look}/>')
        # The names in the order of the ends, apart from each other.
    last = lambda name: next((e for _, e in reversed(curves[name]) if math.isfinite(e)), math.inf)
    order = sorted(curves, key=lambda name: -last(name))
    for at, name in enumerate(order):
        k, y = list(curves).index(name), top + 20 + at * 26
        look = f'stroke="{INKS[k % len(INKS)]}" stroke-width="2" stroke-dasharray="{DASHES[k % len(DASHES)]}"'
        parts.append(f'<path d="M{wide - right + 20} {y}h36" {look}/>' + text(wide - right + 64, y + 5, name))
    path.write_text("\n".join(parts) + "\n</svg>\n")


def main():
    program = Path(sys.argv[1]).resolve()
    picture = Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else None
    # MuJoCo writes its warnings where it stands.
    os.chdir(tempfile.mkdtemp())
    print(", ".join(f"{name} {version}" for name, version in
                    (("MuJoCo", MUJOCO), ("Drake", DRAKE), ("Basilisk", BASILISK)) if version), "\n")
    curves = tumbling(program)
    if picture:
        draw(curves, picture)
    for name, scene in SCENES.items():
        # Where no digits are published: eight stages and the explicit eighth order agree. So it is at the times of another clock.
        def confirmed(seconds):
            one, other = (
                with_vpd(program, dict(scene, seconds=seconds), method, 2000, 1)[0]
                for method in ({"name": "vpd", "tableau": "gauss8"}, {"name": "rk_projected", "tableau": "rk8"})
            )
            assert angle(one, other) < 1e-12, angle(one, other)
            return one

        known = scene["known"] or confirmed(scene["seconds"])
        steps = scene["steps"]
        print(f"| {name} |" + "".join(f" error in {count} steps |" for count in steps) + " us a step |")
        print("|---|" + "---|" * len(steps) + "---|")
        runs = {}
        if mujoco:
            runs |= {f"MuJoCo {MUJOCO} {kind}": lambda *n, kind=kind: with_mujoco(scene, kind, *n) for kind in THEIRS}
        # Both carry bodies that are free, and nothing else without a model of our own.
        if not scene["gravity"] and "damping" not in scene:
            if drake:
                runs |= {f"Drake {DRAKE} {kind}": lambda *n, kind=kind: with_drake(scene, kind, *n)
                         for kind in ("discrete", "runge_kutta3", "runge_kutta5")}
            if basilisk:
                runs |= {f"Basilisk {BASILISK} {kind}": lambda *n, kind=kind: with_basilisk(scene, kind, *n) for kind in ("RK4", "RKF78")}
        runs |= {label: lambda *n, method=method: with_vpd(program, scene, method, *n) for label, method in OURS}
        for label, run in runs.items():
            row = f"| {label} |"
            times = []
            for count in steps:
                found, seconds, *clock = run(count, 1 if times else REPEATS)
                goal = confirmed(clock[0]) if clock and clock[0] != scene["seconds"] else known
                row += f" {angle(found, goal):.1e} |" if found else " fails |"
                times.append(f" {seconds * 1e6:.2f} |" if found else " - |")
            print(row + times[0], flush=True)
        print()


if __name__ == "__main__":
    main()


"""What Python costs: the figures of docs/python.md, as tables.

    python python/benches/python.py target/release/vpd

Needs `vpdsim`; `mujoco` and `heyoka` are measured where they are installed. Each time is the least of several, and what is compared
runs in turn, so that other work on the machine meets both.
"""

import importlib.metadata
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import vpdsim as vpd

ROOT = Path(__file__).resolve().parents[2]
DIPOLE = json.loads((ROOT / "scenarios/dipole.json").read_text()) | {"expect": {}}
ROUNDS = 15

# A body that turns over, docs/cross-checks.md: its attitude at the end is known, quaternion w, x, y, z.
SECONDS = 41.5092195293385
KNOWN = np.array([-0.653684370304628, -0.003783789195234, -0.75675783904679, 0.0])
OMEGA = [0.01, 1.0, 0.0]
MOMENTS = [1.0, 2.0, 3.0]


def timed(call):
    """The time of a call in s; one that returns a number has measured a part of itself."""
    begun = time.perf_counter()
    found = call()
    whole = time.perf_counter() - begun
    return found if isinstance(found, float) else whole


def in_turn(**calls):
    """The least time of each, in s."""
    least = dict.fromkeys(calls, math.inf)
    for _ in range(ROUNDS):
        for name, call in calls.items():
            least[name] = min(least[name], timed(call))
    return least


def runs(program):
    """A run of 1e5 steps with each step kept, next to the command line without samples."""
    quiet = [program, "run", str(ROOT / "scenarios/dipole.json"), "--no-log", "--json", "--set", "/log/every=100000"]
    found = in_turn(
        python=lambda: vpd.run(DIPOLE, set={"/log/every": 1}),
        few=lambda: vpd.run(DIPOLE, set={"/log/every": 100_000}),
        state=lambda: vpd.run(DIPOLE, set={"/log/every": 1, "/log/channels": ["/state"]}),
        command=lambda: subprocess.run(quiet, check=True, stdout=subprocess.DEVNULL),
    )
    print("| 1e5 steps of the dipole | ms | of the command line |\n|---|---|---|")
    for name, words in {
        "command": "`vpd run --no-log`, 2 samples, one process",
        "few": "`vpdsim.run`, 2 samples",
        "state": "`vpdsim.run`, 100,001 samples, `/state` alone",
        "python": "`vpdsim.run`, 100,001 samples, all channels",
    }.items():
        print(f"| {words} | {1e3 * found[name]:.0f} | {found[name] / found['command']:.2f} |")


def steps():
    """A step, and what a controller in Python adds to it."""
    count = 5000
    torques = [np.array([0.001, 0.002, 0.003]) * k for k in range(2)]

    def begun():
        sim = vpd.Simulation(DIPOLE)
        sim.torque = torques[1]
        return sim

    def together():
        sim = begun()
        return timed(lambda: sim.advance(steps=count))

    def alone():
        sim = begun()

        def loop():
            for _ in range(count):
                sim.advance(steps=1)

        return timed(loop)

    def controlled():
        sim = begun()

        def loop():
            for k in range(count):
                sim.torque = torques[k & 1]
                sim.advance(steps=1)
                sim.attitude

        return timed(loop)

    rows = {
        together: "`advance(steps=5000)`",
        alone: "`advance(steps=1)`",
        controlled: "`advance(steps=1)`, reading `attitude`, setting a torque of another value",
    }
    least = dict.fromkeys(rows, math.inf)
    for _ in range(ROUNDS):
        for call in rows:
            least[call] = min(least[call], call())
    print("\n| a step of the dipole with a torque | us |\n|---|---|")
    for call, words in rows.items():
        print(f"| {words} | {1e6 * least[call] / count:.2f} |")
    print(f"\nA controller adds {1e6 * (least[controlled] - least[together]) / count:.2f} us to a step.")


def angle(q):
    """The angle between two attitudes, exact for small ones."""
    half = min(np.linalg.norm(q - KNOWN), np.linalg.norm(q + KNOWN)) / 2
    return 4 * math.asin(min(1.0, half))


def with_vpd(tableau, count):
    scene = {
        "name": "turns over",
        "scene": {"inertia": {"principal": MOMENTS}, "initial": {"angular_velocity": {"body": OMEGA}}},
        "method": {"name": "vpd", "tableau": tableau},
        "step_s": SECONDS / count, "steps": count, "log": {"every": count},
    }

    def loop():
        sim = vpd.Simulation(scene)

        def steps():
            for _ in range(count):
                sim.advance(steps=1)

        return timed(steps)

    return f"`vpd` {tableau}", count, angle(vpd.run(scene).quaternion[-1]), {"whole": lambda: vpd.run(scene), "loop": loop}


def with_mujoco(count):
    import mujoco

    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{SECONDS / count!r}" integrator="RK4" gravity="0 0 0">
        <flag contact="disable" constraint="disable"/></option>
      <worldbody><body><joint type="ball"/>
        <inertial pos="0 0 0" mass="1" diaginertia="{' '.join(map(str, MOMENTS))}"/></body></worldbody></mujoco>""")

    def begun():
        data = mujoco.MjData(model)
        data.qvel[:] = OMEGA
        return data

    def loop():
        data = begun()
        for _ in range(count):
            mujoco.mj_step(model, data)
        return data

    return "RK4", count, angle(loop().qpos), {"whole": lambda: mujoco.mj_step(model, begun(), nstep=count), "loop": loop}


def with_heyoka(tolerance):
    import heyoka as hy

    names = ["w", "x", "y", "z", "a", "b", "c"]
    w, x, y, z, a, b, c = hy.make_vars(*names)
    i, j, k = MOMENTS
    equations = [
        (w, 0.5 * (-x * a - y * b - z * c)), (x, 0.5 * (w * a + y * c - z * b)),
        (y, 0.5 * (w * b + z * a - x * c)), (z, 0.5 * (w * c + x * b - y * a)),
        (a, (j - k) / i * b * c), (b, (k - i) / j * c * a), (c, (i - j) / k * a * b),
    ]
    start = [1.0, 0.0, 0.0, 0.0, *OMEGA]
    stepper = hy.taylor_adaptive(equations, start, tol=tolerance)

    def reset():
        stepper.time = 0.0
        stepper.state[:] = start

    def whole():
        reset()
        return stepper.propagate_until(SECONDS)

    def loop():
        reset()
        while stepper.time < SECONDS:
            stepper.step(max_delta_t=SECONDS - stepper.time)

    count = whole()[3]
    return f"Taylor, tolerance {tolerance:.0e}", count, angle(stepper.state[:4]), {"whole": whole, "loop": loop}


def others():
    """One free body in three programs, at about the same error."""
    rows = []
    for name, package, made in [
        ("vpd", "vpdsim", [lambda: with_vpd("gauss3", 150), lambda: with_vpd("gauss4", 150), lambda: with_vpd("gauss5", 250)]),
        ("MuJoCo", "mujoco", [lambda: with_mujoco(500), lambda: with_mujoco(3000), lambda: with_mujoco(20_000)]),
        ("heyoka", "heyoka", [lambda: with_heyoka(1e-7), lambda: with_heyoka(1e-10), lambda: with_heyoka(1e-13)]),
    ]:
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            print(f"\n{name} is not installed")
            continue
        for make in made:
            words, count, error, calls = make()
            rows.append((f"{name} {version}, {words}", count, error, in_turn(**calls)))
    print("\n| program | steps | error, rad | ms, in one call | ms, a call for each step | us a step there |\n|---|---|---|---|---|---|")
    for words, count, error, found in rows:
        print(f"| {words} | {count} | {error:.0e} | {1e3 * found['whole']:.3f} | {1e3 * found['loop']:.3f} | {1e6 * found['loop'] / count:.2f} |")


def main():
    runs(sys.argv[1])
    steps()
    others()


if __name__ == "__main__":
    main()

"""vpd next to MuJoCo: the same three scenes on the same machine, error against the same known answers, and time.

    python3 -m venv venv && venv/bin/pip install mujoco==3.3.7
    venv/bin/python docs/simulators.py target/release/vpd

Both carry one body at a fixed point from a given state to a time at which its attitude is known. Both are asked for several
steps. The time is that of the steps alone, the least of fifteen runs: of MuJoCo that of one call of mj_step with all steps, in C,
contacts and constraints switched off; of vpd what it reports of its integrator, with a sample at both ends. The error is the angle
between the attitude reached and the known one, in radians.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco

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


def with_mujoco(scene, integrator, steps):
    model = mujoco_model(scene, integrator, scene["seconds"] / steps)
    best, found = math.inf, None
    for _ in range(REPEATS):
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


def with_vpd(program, scene, method, steps, repeats=REPEATS):
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


def main():
    program = Path(sys.argv[1]).resolve()
    # It writes its warnings where it stands.
    os.chdir(tempfile.mkdtemp())
    print(f"MuJoCo {mujoco.__version__}\n")
    for name, scene in SCENES.items():
        # Where no digits are published: eight stages and the explicit eighth order agree.
        known = scene["known"]
        if known is None:
            one, other = (
                with_vpd(program, scene, method, 2000, 1)[0]
                for method in ({"name": "vpd", "tableau": "gauss8"}, {"name": "rk_projected", "tableau": "rk8"})
            )
            assert angle(one, other) < 1e-12, angle(one, other)
            known = one
        steps = scene["steps"]
        print(f"| {name} |" + "".join(f" error in {count} steps | us a step |" for count in steps))
        print("|---|" + "---|---|" * len(steps))
        for label, run in [(f"MuJoCo {kind}", lambda n, kind=kind: with_mujoco(scene, kind, n)) for kind in THEIRS] + [
            (label, lambda n, method=method: with_vpd(program, scene, method, n)) for label, method in OURS
        ]:
            row = f"| {label} |"
            for count in steps:
                found, seconds = run(count)
                row += f" {angle(found, known):.1e} | {seconds * 1e6:.2f} |" if found else " fails | - |"
            print(row, flush=True)
        print()


main()

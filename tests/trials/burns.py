"""Does vpd see short burns in long runs? Tumbling bodies that thrusters push, next to explicit steps from knot to knot.

    python3 tests/trials/burns.py            accuracies: 200 scenes, each asked for an accuracy of 1e-4 to 1e-9
    python3 tests/trials/burns.py --fixed    fixed steps: the order of a method is kept wherever the knots lie
    python3 tests/trials/burns.py --cost     the time of a run whose table has knots, in parts of one without

The other solutions never step over a knot: scipy's DOP853 at rtol = 1e-13 for a unit quaternion and the body momentum, and
Taylor series in 80-bit floats for the body momentum and the space axes as the body sees them. Errors are held against the
series, which is exact where doubles lose digits in long runs; how far it is from itself at other steps and from DOP853 is shown.

Accuracies: none is missed; one is refused only where a rounding of the start grows past it; at most 3 % are refused.
Fixed steps: the error falls at least as the order says. Cost: at most 1.1.
"""

import json
import math
import os
import random
import subprocess
from collections import Counter

import numpy as np
from scipy.integrate import solve_ivp

from trial import Program, arguments, distance, end_of, leave, norm, stretches

# 80 bits where the processor has them (x86-64).
REAL = np.longdouble
ROUNDING, ROUNDING_80 = 2.0**-53, REAL(2) ** -64
# Of the Taylor series.
ORDER = 36
# Of DOP853, relative.
TOLERANCE = 1e-13
# By this a state is moved, to see by how much a rounding of it grows.
MOVED = 1e-10
# The longest of the fixed steps; knots of burns are farther apart, for a step never is longer than the time between two of them.
LONGEST_S = 0.6
ORDERS = {("vpd", "gauss1"): 2, ("vpd", "gauss2"): 4, ("vpd", "gauss3"): 6, ("rkmk", "rk4"): 4, ("rkmk", "rk8"): 8}


# Scenes.


def between(rng, low, high):
    """Evenly spread logarithms."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def direction(rng):
    v = np.array([rng.gauss(0, 1) for _ in range(3)])
    return v / np.linalg.norm(v)


def burn_table(kind, windows, strengths, duration_s, least, rng):
    """Strength over time: burns in windows, nothing between them. `least` is the least share between two knots of a burn."""
    times, values = [0.0], [0.0]
    for (start, end), f in zip(windows, strengths):
        u, v = sorted(rng.uniform(0, 1 - 3 * least) for _ in range(2))
        u, v = start + (end - start) * (u + least), start + (end - start) * (v + 2 * least)
        rows = {
            "ramps": [(start, 0), (u, f), (v, f), (end, 0)],
            "hold": [(start, f), (v, 0.5 * f), (end, 0)],
            "jumps": [(start, 0), (start, f), (end, f), (end, 0)],
            "monotone": [(start, 0), (u, f), (v, 0.6 * f), (end, 0)],
            "monotone_jumps": [(start, 0), (start, f), (u, 1.3 * f), (v, 0.7 * f), (end, f), (end, 0)],
        }[kind]
        if times[-1] == start:
            # From the start of the run on.
            times, values = [], []
            rows = rows[1:] if kind in ("jumps", "monotone_jumps") else rows
        times += [row[0] for row in rows]
        values += [row[1] for row in rows]
    if times[-1] < duration_s:
        # Some tables are longer than the run.
        times.append(duration_s + rng.choice([0.0, 0.0, 3.5]))
        values.append(0.0)
    interpolation = {"ramps": "linear", "hold": "hold", "jumps": "linear"}.get(kind)
    table = {"times_s": times, "values": values}
    return table | ({"interpolation": interpolation} if interpolation else {})


def burns(rng, duration_s, count, lengths_s, gains_rad_s, inertia, least=0.02, apart=False):
    """Torques of burns, in one table or in one each, where they may overlap; each changes the rate by one of the gains."""
    together = rng.random() < 0.5
    kinds = ["ramps", "hold", "jumps", "monotone", "monotone_jumps"]
    windows = []
    for k in range(count):
        # Burns that do not overlap have a share of the run each.
        first, last = (duration_s * k / count, duration_s * (k + 1) / count) if together or apart else (0.0, duration_s)
        length = min(between(rng, *lengths_s), 0.8 * (last - first))
        start = rng.uniform(first, last - length)
        # Some burn from the start of the run on, some up to its end.
        places = [(start, start + length), (0.0, length), (duration_s - length, duration_s)]
        windows += rng.choices(places, [18, k == 0, k == count - 1])
    strengths = [rng.choice([-1, 1]) * between(rng, *gains_rad_s) * min(inertia) / (end - start) for start, end in windows]
    groups = [list(range(count))] if together else [[k] for k in range(count)]
    torques = []
    for group in groups:
        of_group = [windows[k] for k in group], [strengths[k] for k in group]
        table = burn_table(rng.choice(kinds), *of_group, duration_s, least, rng)
        frame = rng.choice(["body", "body", "space"])
        torques.append({"table": {"along": {frame: direction(rng).tolist()}, "table": table}})
    return torques


def body(rng, rate_rad_s):
    """A body of positive second moments, so that no moment is above the sum of the others, at a random attitude."""
    d = [between(rng, 0.05, 1.0) for _ in range(3)]
    moments = [d[1] + d[2], d[2] + d[0], d[0] + d[1]]
    q = np.array([rng.gauss(0, 1) for _ in range(4)])
    start = {
        "attitude": {"quaternion": (q / np.linalg.norm(q)).tolist()},
        "angular_velocity": {"body": (rate_rad_s * direction(rng)).tolist()},
    }
    return {"inertia": {"principal": moments}, "initial": start}


def accuracy_scene(seed, k):
    rng = random.Random(f"burns {seed} {k}")
    scene = body(rng, between(rng, 1e-4, 1.0))
    duration_s = round(between(rng, 100, 10_000), rng.choice([0, 3]))
    inertia = scene["inertia"]["principal"]
    scene["torques"] = burns(rng, duration_s, rng.randint(1, 5), (0.1, 20), (1e-3, 1.0), inertia)
    asked = 10.0 ** -(4 + k % 6)
    log = {"channels": ["/state"]}
    return {"name": f"burns-{seed}-{k}", "scene": scene, "accuracy": {"error": asked}, "duration_s": duration_s, "log": log}


def fixed_scene(seed, k):
    rng = random.Random(f"fixed {seed} {k}")
    scene = body(rng, rng.uniform(1.0, 3.0))
    inertia = scene["inertia"]["principal"]
    scene["torques"] = burns(rng, 40.0, rng.randint(2, 4), (4 * LONGEST_S, 6), (0.3, 1.0), inertia, 0.25, apart=True)
    return {"name": f"fixed-{seed}-{k}", "scene": scene, "duration_s": 40.0}


# The other solutions.


def start_of(scene):
    """The rotation to space and the body momentum at t = 0."""
    w, x, y, z = scene["initial"]["attitude"]["quaternion"]
    return rotation([w, x, y, z]), np.array(scene["inertia"]["principal"]) * scene["initial"]["angular_velocity"]["body"]


def rotation(q):
    """Of a quaternion w, x, y, z of any length."""
    q = np.asarray(q, REAL)
    w, x, y, z = q / np.sqrt(q @ q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def pushes_of(scenario):
    """[(start_s, end_s, [(direction, whether it is in space, cubic) of each torque that pushes there])]."""
    torques = [torque["table"] for torque in scenario["scene"]["torques"]]
    along = [(np.array(v), frame == "space") for torque in torques for frame, v in torque["along"].items()]
    cut = stretches([torque["table"] for torque in torques], scenario["duration_s"])
    return [(start, end, [(*a, c) for a, c in zip(along, cubics) if any(c)]) for start, end, cubics in cut]


def unit_of(momentum, pushes, length):
    """Of the momentum in a stretch: in parts of it no momentum there is far above one."""
    return norm(momentum) + length * sum(norm(v) * sum(abs(x) * length**i for i, x in enumerate(c)) for v, _, c in pushes)


def series(moments, pushes, state, order):
    """Taylor coefficients of a state: the body momentum p, and the three space axes as the body sees them. Each turns by
    v' = v x Omega, and p' has the pushes too. Shape (order + 1, 4, 3)."""
    c = np.zeros((order + 1, 4, 3), REAL)
    rates = np.zeros((order + 1, 3), REAL)
    c[0] = state
    for k in range(order):
        rates[k] = c[k, 0] / moments
        m = (c[: k + 1].reshape(k + 1, 12).T @ rates[k::-1]).reshape(4, 3, 3)
        c[k + 1, :, 0] = m[:, 1, 2] - m[:, 2, 1]
        c[k + 1, :, 1] = m[:, 2, 0] - m[:, 0, 2]
        c[k + 1, :, 2] = m[:, 0, 1] - m[:, 1, 0]
        for v, in_space, cubic in pushes:
            if in_space:
                c[k + 1, 0] += sum(cubic[i] * (v @ c[k - i, 1:]) for i in range(min(k, 3) + 1))
            elif k < 4:
                c[k + 1, 0] += cubic[k] * v
        c[k + 1] /= k + 1
    return c


def by_series(scenario, order=ORDER, first=0, state=None):
    """Taylor series in 80 bits, from knot to knot. The states at the knots, from that of number `first` on, and the largest
    momentum."""
    moments = np.array(scenario["scene"]["inertia"]["principal"], REAL)
    if state is None:
        attitude, momentum = start_of(scenario["scene"])
        state = np.vstack([momentum, attitude])
    states, largest = [state], norm(state[0])
    for start, end, pushes in pushes_of(scenario)[first:]:
        left = REAL(end) - REAL(start)
        unit = np.array([[unit_of(state[0], pushes, float(left)) or 1.0], [1], [1], [1]], REAL)
        passed = REAL(0)
        while left > 0:
            # A push as it is from now on.
            now = [(v, in_space, later(c, passed)) for v, in_space, c in pushes]
            c = series(moments, now, state, order)
            last = [np.abs(c[k] / unit).max() for k in (order - 1, order)]
            # The last terms are below a rounding.
            h = min([left] + [(ROUNDING_80 / x) ** (REAL(1) / k) for x, k in zip(last, (order - 1, order)) if x > 0])
            h = left if h > 0.999 * left else h
            state = c[order]
            for k in range(order - 1, -1, -1):
                state = state * h + c[k]
            largest = max(largest, norm(state[0]))
            passed, left = passed + h, left - h
        states.append(state)
    return states, largest


def later(cubic, s):
    """The coefficients of a cubic from the time s on."""
    a, b, c, d = (REAL(x) for x in cubic)
    return a + s * (b + s * (c + s * d)), b + s * (2 * c + s * 3 * d), c + s * 3 * d, d


def by_steps(scenario):
    """The end by DOP853 from knot to knot: a unit quaternion, and the body momentum."""
    moments = np.array(scenario["scene"]["inertia"]["principal"])
    q = np.array(scenario["scene"]["initial"]["attitude"]["quaternion"])
    p = np.array(start_of(scenario["scene"])[1], float)
    for start, end, pushes in pushes_of(scenario):
        unit = unit_of(p, pushes, end - start)
        done = solve_ivp(slope(moments / unit, unit, pushes), (0.0, end - start), np.concatenate([q, p / unit]),
                         "DOP853", rtol=TOLERANCE, atol=0.1 * TOLERANCE)
        assert done.success, done.message
        q, p = done.y[:4, -1] / np.linalg.norm(done.y[:4, -1]), unit * done.y[4:, -1]
    return np.array(rotation(q), float), p


def slope(moments, unit, pushes):
    """The right side for `by_steps`, in plain numbers; moments and momentum are in parts of `unit`."""
    j1, j2, j3 = moments.tolist()
    pushes = [(*(v / unit).tolist(), in_space, *c) for v, in_space, c in pushes]

    def at(s, state):
        w, x, y, z, p1, p2, p3 = state.tolist()
        o1, o2, o3 = p1 / j1, p2 / j2, p3 / j3
        f1, f2, f3 = p2 * o3 - p3 * o2, p3 * o1 - p1 * o3, p1 * o2 - p2 * o1
        for d1, d2, d3, in_space, c0, c1, c2, c3 in pushes:
            f = c0 + s * (c1 + s * (c2 + s * c3))
            if in_space:
                # d - 2 w t + 2 v x t with t = v x d: turned back into the body.
                t1, t2, t3 = y * d3 - z * d2, z * d1 - x * d3, x * d2 - y * d1
                d1, d2 = d1 + 2 * (y * t3 - z * t2 - w * t1), d2 + 2 * (z * t1 - x * t3 - w * t2)
                d3 += 2 * (x * t2 - y * t1 - w * t3)
            f1, f2, f3 = f1 + f * d1, f2 + f * d2, f3 + f * d3
        return [
            0.5 * (-x * o1 - y * o2 - z * o3), 0.5 * (w * o1 + y * o3 - z * o2),
            0.5 * (w * o2 + z * o1 - x * o3), 0.5 * (w * o3 + x * o2 - y * o1), f1, f2, f3,
        ]

    return at


def end_by_series(state):
    return np.array(state[1:], float), np.array(state[0], float)


class Reference:
    """The end of a scene by series, its own error (other orders, other steps), and the distance of the end by DOP853."""

    def __init__(self, scenario):
        self.scenario = scenario
        self.states, self.largest = by_series(scenario)
        self.end = end_by_series(self.states[-1])
        self.own = self.away(end_by_series(by_series(scenario, ORDER - 8)[0][-1]))
        self.steps = self.away(by_steps(scenario))

    def away(self, end):
        return distance(end, self.end, self.largest)

    def growth(self):
        """The largest error at the end that one rounding becomes, at the start of the run or after a burn: in six directions."""
        most = 0.0
        for k, (start, end, _) in enumerate(pushes_of(self.scenario)):
            if end - start < 0.01 * self.scenario["duration_s"]:
                continue
            momentum, axes = self.states[k][0], self.states[k][1:]
            for unit in np.eye(3):
                for state in (np.vstack([momentum + MOVED * norm(momentum) * unit, axes]),
                              np.vstack([momentum, axes + MOVED * np.cross(axes, unit)])):
                    states, _ = by_series(self.scenario, first=k, state=state)
                    most = max(most, self.away(end_by_series(states[-1])) / MOVED * ROUNDING)
        return most

    def explains_steps(self):
        """Is DOP853 as near as what it leaves in its steps, ten tolerances, lets it be where errors grow?"""
        return self.steps <= 100 * self.own + 1e-5 or self.steps <= 10 * TOLERANCE / ROUNDING * self.growth()


# Trials.


def accuracies(program, members, seed):
    print(f"{'scene':>6} {'asked':>6} {'error':>8} {'series':>8} {'DOP853':>8} {'turn, rad':>9} {'steps':>8}  is")
    counts = Counter()
    for k in range(members):
        scenario = accuracy_scene(seed, k)
        asked = scenario["accuracy"]["error"]
        right = Reference(scenario)
        summary, wrong = program.run(scenario)
        error, steps = math.nan, 0
        if summary:
            error, steps = right.away(end_of(summary)), summary["steps"]
            verdict = "met" if error <= asked else "MISSED"
        elif wrong.startswith("exit 2"):
            grown = right.growth()
            verdict = "refused rightly" if grown > asked else "REFUSED WITHOUT NEED"
            wrong += f" (a rounding grows to {grown:.1e})"
        else:
            verdict = "FAILED"
        if verdict != "FAILED" and (right.own > 0.01 * asked or not right.explains_steps()):
            verdict = "undecided"
        counts[verdict] += 1
        if verdict.isupper():
            attitude, momentum = right.end
            program.keep(scenario, verdict=verdict, said=wrong, error=error, attitude=attitude, body_momentum=momentum)
        turn = right.largest / min(scenario["scene"]["inertia"]["principal"]) * scenario["duration_s"]
        figures = f"{k:6} {asked:6.0e} {error:8.1e} {right.own:8.1e} {right.steps:8.1e} {turn:9.0f} {steps:8}"
        print(f"{figures}  {verdict} {wrong}", flush=True)
    refused = counts["refused rightly"] + counts["REFUSED WITHOUT NEED"]
    leave(counts, any(verdict.isupper() for verdict in counts) or refused > 0.03 * members)


def fixed_steps(program, members, seed):
    """Errors at steps that fall by 2^(1/3). The slope is that of the six finest that are neither coarse nor at round-off."""
    print(f"{'scene':>6} {'method':>12} {'order':>5} {'slope':>6}  errors")
    counts = Counter()
    for k in range(members):
        scenario = fixed_scene(seed, k)
        right = Reference(scenario)
        for (name, tableau), order in ORDERS.items():
            points, errors = [], []
            for thirds in range(30):
                steps = round(scenario["duration_s"] / LONGEST_S * 2 ** (thirds / 3))
                step_s = scenario["duration_s"] / steps
                asked = {"step_s": step_s, "steps": steps, "method": {"name": name, "tableau": tableau}}
                asked["log"] = {"every": steps, "channels": ["/state"]}
                summary, wrong = program.run({key: scenario[key] for key in ("name", "scene")} | asked)
                error = right.away(end_of(summary)) if summary else math.nan
                # Rounding: of each step.
                if error < 1e-12 + 1e-15 * steps:
                    break
                errors.append(error)
                points += [(math.log(step_s), math.log(error))] if error < 1e-2 else []
            slope = np.polyfit(*zip(*points[-6:]), 1)[0] if len(points) >= 5 else math.nan
            verdict = "by the order" if slope > 0.9 * order else "BELOW THE ORDER"
            counts[verdict] += 1
            if verdict.isupper():
                method = {"name": name, "tableau": tableau}
                program.keep(scenario | {"name": f"{scenario['name']}-{tableau}", "method": method, "step_s": 0.1},
                             verdict=verdict, slope=slope, attitude=right.end[0], body_momentum=right.end[1])
            print(f"{k:6} {name + ' ' + tableau:>12} {order:5} {slope:6.2f}  "
                  + " ".join(f"{error:.0e}" for error in errors) + (f" {verdict}" if verdict.isupper() else ""), flush=True)
    leave(counts, any(verdict.isupper() for verdict in counts))


def seconds(program, scenario):
    """The processor time of one run, of the user."""
    path = os.path.join(program.folder.name, "scenario.json")
    with open(path, "w") as file:
        file.write(json.dumps(scenario))
    command = program.command("run", path, "--json", "--force", "-o", os.path.join(program.folder.name, "run.mcap"))
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    assert status == 0, f"the run ended with status {status}"
    return usage.ru_utime


def costs(program, members, seed):
    """Weak torques, so that both bodies move alike; the least of several runs, in turn."""
    print(f"{'method':>14} {'with knots, s':>14} {'without, s':>11} {'ratio':>6}")
    counts = Counter()
    runs = [("vpd", "gauss2", 400_000), ("vpd", "gauss3", 300_000), ("rkmk", "rk4", 600_000), (None, None, 400_000)]
    for name, tableau, steps in runs:
        rng = random.Random(f"cost {seed}")
        scene = body(rng, 1.0)
        duration_s = steps * 0.01
        along = direction(rng).tolist()
        least = [math.inf, math.inf]
        inner = sorted(rng.uniform(0, duration_s) for _ in range(4))
        knots = [0.0, *inner, duration_s], [1e-6, 1.3e-6, 0.8e-6, 1.1e-6, 0.9e-6, 1e-6]
        tables = [knots, ([0.0, duration_s], [1e-6, 1e-6])]
        for _ in range(members):
            for k, (times, values) in enumerate(tables):
                table = {"times_s": times, "values": values, "interpolation": "linear"}
                pushed = scene | {"torques": [{"table": {"along": {"body": along}, "table": table}}]}
                scenario = {"name": "cost", "scene": pushed, "step_s": 0.01, "steps": steps}
                scenario |= {"log": {"every": steps, "channels": ["/state"]}}
                scenario |= {"method": {"name": name, "tableau": tableau}} if name else {}
                least[k] = min(least[k], seconds(program, scenario))
        ratio = least[0] / least[1]
        verdict = "cheap" if ratio <= 1.1 else "DEAR"
        counts[verdict] += 1
        print(f"{f'{name} {tableau}' if name else 'default':>14} {least[0]:14.3f} {least[1]:11.3f} {ratio:6.3f}", flush=True)
    leave(counts, "DEAR" in counts)


def main():
    parser = arguments(__doc__.splitlines()[0], 200)
    parser.add_argument("--fixed", action="store_true", help="orders at fixed steps, of N scenes (6 if absent)")
    parser.add_argument("--cost", action="store_true", help="cost of knots, the least of N runs (5 if absent)")
    parser.set_defaults(members=None)
    given = parser.parse_args()
    trial, usual = (fixed_steps, 6) if given.fixed else (costs, 5) if given.cost else (accuracies, 200)
    trial(Program(given.vpd, given.failing), given.members or usual, given.seed)


if __name__ == "__main__":
    main()

"""Does vpd keep its word on accuracies? A trial by Taylor series in 80-bit floats, which share nothing with it but the scenario.

    python3 -m venv venv && venv/bin/pip install heyoka numpy
    venv/bin/python docs/independent.py target/release/vpd FOLDER [WORD]

Another WORD makes other scenes.

It makes random scenes, asks vpd for an accuracy of each, and holds the end of the run against heyoka's taylor_adaptive. The
equations come from the energies that docs/scenario.md defines, which heyoka differentiates itself: a unit quaternion q and the body
momentum mu follow q' = q Omega / 2, mu' = mu x Omega - dU/dturn, Omega = J^-1 mu.

1. 60 scenes, 60 to 800 s, with errors of 1e-4, 1e-6 and 1e-8 in turn. A run that is accepted is `met` or `MISSED`. One that is
   refused is held against what doubles can have: the scene is run by four fine runs of vpd of order 16. If one of them
   misses the accuracy, or the rounding of the start alone has grown past it, the refusal is `right`; else it is `CAUTIOUS`.
2. The same for 30 scenes at the edge of what doubles have, and for 12 that are longer than any reference of vpd.
3. 20 ensembles of 8 to 16 members, each of which has to keep the accuracy.
4. `vpd run --error`, on 20 of the scenes with methods and steps of all kinds and on all accepted runs of 1 and 2: it may be wrong
   by a factor of 3.

An error is what the README says: that of the attitude (spectral norm) and that of the body momentum in parts of the largest one. A
reference vouches for itself: its energy stays, other steps lead to the same end (`known`), and starts 1e-16 away, in six
directions, show by how much a rounding grows (`growth`). All scenarios are left in FOLDER.
"""

import csv
import io
import json
import math
import random
import re
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import heyoka as hy
import numpy as np

SCENES, EDGES, LONG, ENSEMBLES, ESTIMATES = 60, 30, 12, 20, 20
WORD = sys.argv[3] if len(sys.argv) > 3 else "vpd"
TARGETS = [1e-4, 1e-6, 1e-8]
LIMIT_S = 120
REAL = np.longdouble
# Of doubles: the largest relative rounding of a number.
ROUNDING = 2.0**-53
# By this a start is moved.
MOVED = REAL(1e-16)
# Number of intervals in the time grid of a reference.
GRID = 2000


# Quaternions w, x, y, z and vectors of three: of numbers as well as of heyoka's expressions.


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def apply(rows, vector):
    return [dot(row, vector) for row in rows]


def transposed(rows):
    return [list(column) for column in zip(*rows)]


def times(a, b):
    """The product of a quaternion and a vector."""
    w, v = a[0], a[1:]
    return [-dot(v, b)] + [w * x + y for x, y in zip(b, cross(v, b))]


def matrix(q):
    """From body to space coordinates, of a unit quaternion."""
    w, x, y, z = q
    return [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]


def normalised(q):
    q = np.array(q, dtype=REAL)
    return q / np.sqrt(np.sum(q * q))


def quaternion(rows):
    """Of the rotation next to a matrix that is one up to rounding."""
    g = np.array(rows, dtype=REAL)
    for _ in range(3):
        g = g * REAL(1.5) - g @ g.T @ g * REAL(0.5)
    (a, b, c), (d, e, f), (k, h, i) = g
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    return normalised([
        [squares[0], h - f, c - k, d - b],
        [h - f, squares[1], b + d, c + k],
        [c - k, b + d, squares[2], f + h],
        [d - b, c + k, f + h, squares[3]],
    ][int(np.argmax(squares))])


def inverse(rows):
    a, b, c = rows
    columns = [cross(b, c), cross(c, a), cross(a, b)]
    return [[columns[j][i] / dot(a, columns[0]) for j in range(3)] for i in range(3)]


# What docs/scenario.md defines.


def inertia(scene):
    given = scene["inertia"]
    if "matrix" in given:
        return [[REAL(x) for x in row] for row in given["matrix"]]
    if "principal" in given:
        moments = [REAL(x) for x in given["principal"]]
    else:
        d = [REAL(x) for x in given["second_moments"]]
        moments = [sum(d) - x for x in d]
    return [[moments[i] if i == j else REAL(0) for j in range(3)] for i in range(3)]


def potential(scene, g):
    """The energy of all terms at an attitude g."""
    total = 0 * g[0][0]
    for term in scene.get("potential", []):
        if term["kind"] == "gravity_gradient":
            down = apply(transposed(g), term["direction"])
            total += term["strength"] * 0.5 * dot(down, apply(term.get("matrix", inertia(scene)), down))
            continue
        point = apply(g, term["body_point"])
        if term["kind"] == "uniform":
            total += term["weight"] * dot(term["direction"], point)
            continue
        away = [x - z for x, z in zip(point, term["position"])]
        distance = dot(away, away) ** 0.5
        if term["kind"] == "point_source":
            total += term["strength"] / distance
        else:
            total += term["stiffness"] * 0.5 * (distance - term.get("rest_length", 0.0)) ** 2
    return total


def start(scene):
    """The quaternion and the body momentum, as if scenarios had all digits."""
    given = scene["initial"]
    attitude = given.get("attitude", {"quaternion": [1, 0, 0, 0]})
    if "quaternion" in attitude:
        q = normalised(attitude["quaternion"])
    else:
        turn = attitude["axis_angle"]
        axis, half = normalised(turn["axis"]), REAL(turn["angle_rad"]) / 2
        q = np.array([np.cos(half), *(np.sin(half) * axis)], dtype=REAL)
    ((frame, vector),) = given.get("momentum", given.get("angular_velocity")).items()
    vector = [REAL(x) for x in vector]
    if frame == "space":
        vector = apply(transposed(matrix(q)), vector)
    if "angular_velocity" in given:
        vector = apply(inertia(scene), vector)
    return q, np.array(vector, dtype=REAL)


class Taylor:
    """The motions of a scene."""

    def __init__(self, scene, rounded=False):
        self.scene = scene
        self.rate = inverse(inertia(scene))
        if rounded:
            self.rate = [[REAL(float(x)) for x in row] for row in self.rate]
        names = "qw qx qy qz mx my mz".split()
        variables = hy.make_vars(*names)
        q, mu = variables[:4], variables[4:]
        omega = [sum(hy.expression(x) * m for x, m in zip(row, mu) if x != 0) for row in self.rate]
        torque = [0.0, 0.0, 0.0]
        if scene.get("potential"):
            slope = hy.diff_tensors([potential(scene, matrix(q))], diff_args=list(q), diff_order=1).gradient
            for k in range(3):
                turned = times(q, [float(k == j) for j in range(3)])
                torque[k] = -0.5 * sum(s * t for s, t in zip(slope, turned))
        equations = [0.5 * x for x in times(q, omega)]
        equations += [x + y for x, y in zip(cross(mu, omega), torque)]
        self.integrator = hy.taylor_adaptive(
            list(zip(variables, equations)), np.zeros(7, dtype=REAL), fp_type=REAL, tol=REAL(1e-19), high_accuracy=True,
            compact_mode=True,
        )

    def go(self, q, mu, times, **options):
        """The states at some times, and the number of steps."""
        self.integrator.time = REAL(0)
        self.integrator.state[:] = [*q, *mu]
        outcome = self.integrator.propagate_grid(times, **options)
        assert outcome[0] == hy.taylor_outcome.time_limit, outcome[0]
        return outcome[-1], outcome[3]

    def energy(self, state):
        q, mu = normalised(state[:4]), state[4:]
        return 0.5 * dot(mu, apply(self.rate, mu)) + potential(self.scene, matrix(q))


class Reference:
    """Where a motion ends, and how well that is known."""

    def __init__(self, taylor, q, mu, seconds, directions=range(6)):
        grid = np.linspace(REAL(0), REAL(1), GRID + 1, dtype=REAL) * REAL(seconds)
        states, steps = taylor.go(q, mu, grid)
        self.seconds, self.grid, self.states = seconds, grid, states
        self.largest = float(np.max(np.sqrt(np.sum(states[:, 4:] ** 2, axis=1))))
        self.fastest = max(math.sqrt(dot(v, v)) for v in (apply(taylor.rate, s[4:]) for s in states))
        energies = [taylor.energy(state) for state in states[:: GRID // 20]]
        potentials = [potential(taylor.scene, matrix(normalised(state[:4]))) for state in states[:: GRID // 20]]
        size = max(max(abs(u), abs(energy - u)) for energy, u in zip(energies, potentials))
        self.drift = float(max(abs(energy - energies[0]) for energy in energies) / size)
        shorter = REAL(0.6) * REAL(seconds) / steps
        again, _ = taylor.go(q, mu, grid[[0, -1]], max_delta_t=shorter)
        self.known = self.apart(again[-1])
        # By how much a rounding of the start has grown at each time: the root of the sum of six squares.
        total = np.zeros(GRID + 1)
        for k in directions:
            unit = np.array([REAL(k % 3 == j) for j in range(3)], dtype=REAL)
            moved_q, moved_mu = q, mu
            if k < 3:
                moved_q = normalised(q + MOVED / 2 * np.array(times(list(q), list(unit)), dtype=REAL))
            else:
                moved_mu = mu + MOVED * self.largest * unit
            moved, _ = taylor.go(moved_q, moved_mu, grid)
            total += np.array([self.apart(state, at) for at, state in enumerate(moved)]) ** 2
        self.growths = np.sqrt(total) / float(MOVED)
        self.growth = float(self.growths[-1])

    def apart(self, state, at=-1):
        return self.error(matrix(normalised(state[:4])), state[4:], at)

    def error(self, attitude, momentum, at=-1):
        own = self.states[at]
        attitudes = np.array(attitude, dtype=REAL) - np.array(matrix(normalised(own[:4])), dtype=REAL)
        momenta = np.array(momentum, dtype=REAL) - own[4:]
        # Of a difference of two rotations two singular values are equal, the third is 0.
        return float(np.sqrt(np.sum(attitudes**2) / 2) + np.sqrt(np.sum(momenta**2)) / REAL(self.largest))

    def until(self, target):
        """When the rounding of the start alone reaches an error."""
        past = np.nonzero(self.growths * ROUNDING > target)[0]
        return float(self.grid[past[0]]) if len(past) else math.inf


# Scenes.


def digits(x, count=4):
    return float(f"{x:.{count}g}")


def direction(chance, size=1.0):
    v = [chance.gauss(0, 1) for _ in range(3)]
    return [digits(size * x / math.hypot(*v)) for x in v]


def between(chance, low, high):
    """With even logarithms."""
    return digits(math.exp(chance.uniform(math.log(low), math.log(high))))


def random_inertia(chance, kind):
    d = [between(chance, 0.1, 1) for _ in range(3)]
    if kind == "symmetric":
        d[1] = d[0]
    moments = [d[1] + d[2], d[0] + d[2], d[0] + d[1]]
    form = chance.choice(["principal", "principal", "second_moments", "matrix"])
    if form == "second_moments":
        return {"second_moments": d}, moments
    if form == "matrix" and kind != "symmetric":
        g = np.array(matrix(normalised([chance.gauss(0, 1) for _ in range(4)])), dtype=float)
        rows = g @ np.diag(moments) @ g.T
        rows = [[digits(rows[min(i, j)][max(i, j)], 6) for j in range(3)] for i in range(3)]
        return {"matrix": rows}, moments
    return {"principal": [digits(x, 6) for x in moments]}, moments


def uniform(chance, strength):
    arm = between(chance, 0.3, 1)
    return {
        "kind": "uniform", "weight": digits(strength / arm), "body_point": direction(chance, arm), "direction": direction(chance)
    }


def spring(chance, strength):
    arm, far = between(chance, 0.3, 1), between(chance, 0.5, 3)
    term = {
        "kind": "spring", "stiffness": digits(strength / arm / far), "body_point": direction(chance, arm),
        "position": direction(chance, far),
    }
    if chance.random() < 0.6:
        # The anchor is nearer, or farther, at all times: no spring goes through its length at rest with a kink at 0.
        term["rest_length"] = between(chance, 0.1, 2)
    return term


def source(chance, strength):
    arm = between(chance, 0.3, 1)
    # Outside of the sphere of its point, or inside; now and then it comes near.
    far = arm * (1 + between(chance, 0.06, 2)) if chance.random() < 0.7 else arm * chance.uniform(0.2, 0.9)
    size = strength * abs(far - arm) if far < 2 * arm else strength * far
    sign = chance.choice([-1, 1])
    return {
        "kind": "point_source", "strength": digits(sign * size), "body_point": direction(chance, arm),
        "position": direction(chance, far),
    }


def dipole(chance, strength):
    one = source(chance, strength)
    shift = direction(chance, 0.1 * math.hypot(*one["body_point"]))
    other = {
        **one, "strength": -one["strength"], "body_point": [digits(x + y) for x, y in zip(one["body_point"], shift)],
        "position": [digits(1.3 * x) for x in one["position"]],
    }
    return [one, other]


def gradient(chance, strength, with_matrix):
    term = {"kind": "gravity_gradient", "strength": digits(strength * 2), "direction": direction(chance)}
    if with_matrix:
        rows = [[digits(chance.gauss(0, 1)) for _ in range(3)] for _ in range(3)]
        term["matrix"] = [[rows[min(i, j)][max(i, j)] for j in range(3)] for i in range(3)]
    return term


FAMILIES = ["free", "top", "pendulum", "springs", "sources", "gradient", "sum"]


def random_scene(chance, family, spin):
    """A scene whose velocities are about `spin` rad/s."""
    kind = "symmetric" if family == "top" or (family == "free" and chance.random() < 0.3) else "any"
    given, moments = random_inertia(chance, kind)
    scene = {"inertia": given}
    kinetic = 0.5 * sum(moments) / 3 * spin**2
    # From a perturbation of the free body to a swing.
    strength = kinetic * between(chance, 0.02, 3)
    few = chance.randint(1, 3)
    if family == "top":
        # Lagrange's: the weight on the axis of symmetry.
        axis = [0, 0, between(chance, 0.2, 1)]
        scene["potential"] = [
            {"kind": "uniform", "weight": digits(strength / axis[2]), "body_point": axis, "direction": [0, 0, 1]}
        ]
    elif family == "pendulum":
        scene["potential"] = [uniform(chance, strength)]
    elif family == "springs":
        scene["potential"] = [spring(chance, strength / few) for _ in range(few)]
    elif family == "sources":
        scene["potential"] = dipole(chance, strength) if few == 1 else [source(chance, strength / few) for _ in range(few)]
    elif family == "gradient":
        scene["potential"] = [gradient(chance, strength, chance.random() < 0.4) for _ in range(1 + few // 3)]
    elif family == "sum":
        makers = [uniform, spring, source, lambda chance, s: gradient(chance, s, chance.random() < 0.5)]
        scene["potential"] = [make(chance, strength / 3) for make in chance.sample(makers, chance.randint(2, 4))]
    initial = {}
    turn = chance.random()
    if turn < 0.45:
        initial["attitude"] = {"axis_angle": {"axis": direction(chance), "angle_rad": digits(chance.uniform(0.1, 3))}}
    elif turn < 0.8:
        initial["attitude"] = {"quaternion": [float(x) for x in normalised([chance.gauss(0, 1) for _ in range(4)])]}
    frame = chance.choice(["body", "space"])
    if family == "top" and chance.random() < 0.6:
        # A fast one.
        vector, frame = [digits(chance.gauss(0, 0.1 * spin)), digits(chance.gauss(0, 0.1 * spin)), spin], "body"
    else:
        vector = direction(chance, spin)
    if chance.random() < 0.3:
        initial["momentum"] = {frame: [digits(x * sum(moments) / 3) for x in vector]}
    else:
        initial["angular_velocity"] = {frame: vector}
    scene["initial"] = initial
    return scene


# vpd.


class Program:
    def __init__(self, path, folder):
        self.path, self.folder = path, folder

    def run(self, name, scenario, *options):
        """The summary, or why there is none; the seconds."""
        scenario = {"name": name, **scenario}
        path, log = self.folder / f"{name}.json", self.folder / f"{name}.mcap"
        path.write_text(json.dumps(scenario, indent=1))
        begun = time.perf_counter()
        try:
            done = subprocess.run(
                [self.path, "run", path, "--json", "--force", "-o", log, *options], capture_output=True, text=True,
                timeout=LIMIT_S,
            )
        except subprocess.TimeoutExpired:
            return None, f"more than {LIMIT_S} s", LIMIT_S
        seconds = time.perf_counter() - begun
        why = done.stderr.strip().removeprefix(f"vpd: {path}: ")
        found = json.loads(done.stdout) if done.stdout.strip().startswith("{") else None
        if found and found["outcome"] != "succeeded":
            found, why = None, f"{found['outcome']} {found.get('diagnosis', '')}"
        return found, why, seconds

    def table(self, name, channel):
        log = self.folder / f"{name}.mcap"
        done = subprocess.run([self.path, "export", log, "--channels", channel], capture_output=True, text=True, check=True)
        return list(csv.DictReader(io.StringIO(done.stdout)))

    def drop(self, name):
        (self.folder / f"{name}.mcap").unlink(missing_ok=True)


def fixed(scene, method, steps, seconds):
    return {
        "scene": scene, "method": method, "step_s": seconds / steps, "steps": steps,
        "log": {"every": steps, "channels": ["/state"]},
    }


FINE = [{"name": "vpd", "tableau": "gauss8"}, {"name": "quaternion_gauss", "tableau": "gauss8"}]


def fine_errors(program, name, scene, reference):
    """What runs of order 16 reach by two methods, of each with the last two steps: halved until the error falls no more."""
    found = []
    for method in FINE:
        errors = []
        for halvings in range(8):
            steps = math.ceil(3 * 2**halvings * reference.fastest * reference.seconds)
            summary, _, _ = program.run(f"{name}-fine", fixed(scene, method, steps, reference.seconds))
            errors.append(at_end(reference, summary) if summary else math.inf)
            if halvings and errors[-2] < 4 * errors[-1] and (errors[-1] < 0.1 or halvings > 3):
                break
        found += errors[-2:]
    program.drop(f"{name}-fine")
    return found


def logged(row, end=""):
    """A state from a row of a table."""
    g = [[float(row[f"{end}attitude_{i}_{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)]
    return quaternion(g), np.array([float(row[f"{end}body_momentum_{x}"]) for x in "xyz"], dtype=REAL)


def at_end(reference, summary):
    return reference.error(summary["final"]["attitude"], summary["final"]["body_momentum"])


def of_claim(summary, error):
    """What `--error` says of a run, and whether that is true."""
    if summary.get("error") is not None:
        claimed = summary["error"]
        return f"says {claimed:.1e}", "true" if claimed / 3 <= error <= 3 * claimed else "WRONG"
    if summary.get("error_below") is not None:
        return f"says < {summary['error_below']:.1e}", "below" if error <= summary["error_below"] else "below, WRONG"
    return "says nothing", "none"


def figures(reference):
    return f"growth {reference.growth:.1e}, known {reference.known:.0e}, energy {reference.drift:.0e}"


def vouch(reference):
    """The drift is that of 80-bit floats, and other steps end no farther away than their rounding has grown."""
    assert reference.drift < 1e-15, reference.drift
    assert reference.known < 1e-16 + 300 * reference.growth * 1.1e-19 or reference.known > 1e-2, (reference.known, reference.growth)


def as_doubles(program, name, scene, seconds):
    """The reference from the start that the log has, with the inverse of the inertia in doubles: what every method of vpd has in
    common. An error that is small against this one is no method's."""
    program.run(name, fixed(scene, {"name": "vpd", "tableau": "gauss1"}, 1, 1e-3))
    row = program.table(name, "/state")[0]
    return Reference(Taylor(scene, rounded=True), *logged(row), seconds)


def judge(program, name, scene, reference, target, why):
    """A refusal."""
    errors = fine_errors(program, name, scene, reference)
    of_start = reference.growth * ROUNDING
    verdict = "right" if of_start > target or max(errors) > target else "CAUTIOUS"
    said = re.search(r"until t = ([0-9.e+-]+) s", why)
    if not said:
        verdict += "?"
    until = f"until {float(said[1]):.0f} s, by the start {reference.until(target):.0f}; " if said else ""
    return verdict, f"doubles have {min(errors):.0e} to {max(errors):.0e}, a rounding of the start {of_start:.0e}; {until}{why}"


def trial(program, tally, name, scene, reference, target):
    """Asks for an accuracy, and prints what comes of it."""
    asked = {
        "scene": scene, "accuracy": {"error": target}, "duration_s": reference.seconds,
        "log": {"every": 1_000_000, "channels": ["/state"]},
    }
    vouch(reference)
    summary, why, took = program.run(name, asked)
    if summary:
        assert abs(summary["time_s"] / reference.seconds - 1) < 1e-12
        error = at_end(reference, summary)
        verdict = "met" if error <= target else "MISSED"
        estimated, problem, _ = program.run(name, asked, "--error")
        said, claim = of_claim(estimated, error) if estimated else (problem, "refused")
        tally["--error", claim] += 1
        told = f"{error:.1e} in {summary['steps']} steps, {said}"
        if reference.known > target / 10:
            verdict += "?"
        if verdict != "met" or "WRONG" in claim:
            doubles = as_doubles(program, f"{name}-start", scene, reference.seconds)
            program.drop(f"{name}-start")
            told += f" ({claim}); {at_end(doubles, summary):.1e} from the start and with the inertia as doubles have them"
            told += f"; fine runs {' '.join(f'{e:.1e}' for e in fine_errors(program, name, scene, reference))}"
    else:
        verdict, told = judge(program, name, scene, reference, target, why)
    tally[f"{target:.0e}", verdict] += 1
    tally["share", share(reference, target), verdict] += 1
    print(
        f"{name} {reference.seconds:5.0f} s {reference.fastest * reference.seconds:6.0f} rad, {figures(reference)} | {target:.0e}"
        f" {verdict}: {told} ({took:.1f} s)", flush=True,
    )
    program.drop(name)


SHARES = [1e-3, 1e-2, 0.03, 0.1, 0.3, 1, math.inf]


def share(reference, target):
    """What of an accuracy the rounding of the start alone takes."""
    return next(most for most in SHARES if reference.growth * ROUNDING / target <= most)


def scenes(program, tally):
    print("\n## Scenes\n")
    made = []
    for number in range(SCENES):
        chance = random.Random(f"{WORD}, scene {number}")
        target, family = TARGETS[number % 3], FAMILIES[number // 3 % len(FAMILIES)]
        spin = between(chance, 0.3, 4) if number % 10 else between(chance, 15, 30)
        scene, seconds = random_scene(chance, family, spin), between(chance, 60, 800)
        reference = Reference(Taylor(scene), *start(scene), seconds)
        name = f"scene-{number:02}-{family}"
        made.append((name, scene, reference))
        trial(program, tally, name, scene, reference, target)
    return made


def at_the_edge(program, tally):
    """Chaotic scenes whose time is such that the rounding of the start takes a hundredth to three times of the accuracy."""
    print("\n## At the edge of what doubles have\n")
    number = done = 0
    while done < EDGES:
        chance = random.Random(f"{WORD}, edge {number}")
        number += 1
        target, family = TARGETS[done % 3], chance.choice(FAMILIES[2:])
        scene = random_scene(chance, family, between(chance, 1, 4))
        part = between(chance, 0.01, 3)
        taylor, begin = Taylor(scene), start(scene)
        until = Reference(taylor, *begin, 400.0, directions=[0, 4]).until(part * target)
        if not 60 <= until <= 400:
            continue
        done += 1
        trial(program, tally, f"edge-{number:02}-{family}", scene, Reference(taylor, *begin, digits(until)), target)


def long(program, tally):
    """Scenes that are longer than any reference of vpd."""
    print("\n## Long\n")
    for number in range(LONG):
        chance = random.Random(f"{WORD}, long {number}")
        target, family = TARGETS[number % 3], ["top", "gradient", "springs", "sum", "pendulum"][number % 5]
        scene = random_scene(chance, family, between(chance, 10, 30))
        # Weak forces: most of these are not chaotic.
        for term in scene["potential"]:
            key = {"uniform": "weight", "spring": "stiffness"}.get(term["kind"], "strength")
            term[key] = digits(0.03 * term[key])
        reference = Reference(Taylor(scene), *start(scene), between(chance, 300, 800))
        trial(program, tally, f"long-{number:02}-{family}", scene, reference, target)


def ensembles(program, tally):
    print("\n## Ensembles\n")
    for number in range(ENSEMBLES):
        chance = random.Random(f"{WORD}, ensemble {number}")
        target, family = TARGETS[number % 3], FAMILIES[number % len(FAMILIES)]
        scene, seconds = random_scene(chance, family, between(chance, 0.3, 3)), between(chance, 60, 300)
        members = chance.randint(8, 16)
        spread = {
            "members": members, "seed": number, "attitude_spread_rad": between(chance, 0.01, 0.3),
            "momentum_spread": digits(float(inertia(scene)[0][0]) * between(chance, 0.01, 0.3)),
        }
        name = f"ensemble-{number:02}-{family}"
        asked = {
            "scene": scene, "accuracy": {"error": target}, "duration_s": seconds, "ensemble": spread,
            "log": {"every": 1_000_000, "channels": ["/state", "/ensemble/members"]},
        }
        taylor = Taylor(scene)
        summary, why, took = program.run(name, asked)
        told = f"{name} {seconds:5.0f} s, {members:2} members | {target:.0e}"
        if summary:
            rows = program.table(name, "/ensemble/members")
        else:
            easy = {**fixed(scene, {"name": "vpd", "tableau": "gauss1"}, 1, 1e-3), "ensemble": spread}
            easy["log"]["channels"] = ["/state", "/ensemble/members"]
            program.run(f"{name}-starts", easy)
            rows = program.table(f"{name}-starts", "/ensemble/members")
            program.drop(f"{name}-starts")
        assert [int(row["member"]) for row in rows] == list(range(members))
        assert all(row["outcome"] == "succeeded" for row in rows)
        (exact, momentum), (q, mu) = start(scene), logged(rows[0], "initial_")
        assert np.max(abs(np.array(matrix(exact)) - np.array(matrix(q)))) < 2e-15
        assert np.max(abs(momentum - mu)) < 2e-15 * (1 + np.max(abs(mu)))
        references = [Reference(taylor, *logged(row, "initial_"), seconds) for row in rows]
        for reference in references:
            vouch(reference)
        if summary:
            ends = [logged(row) for row in rows]
            errors = [reference.error(matrix(q), mu) for reference, (q, mu) in zip(references, ends)]
            missed = [k for k, error in enumerate(errors) if error > target]
            verdict = "met" if not missed else "MISSED"
            worst = int(np.argmax(errors))
            told += f" {verdict}: worst {max(errors):.1e} (member {worst}, {figures(references[worst])}), best {min(errors):.1e}"
        else:
            # The member that is named; one of a scene that is refused as a whole is the first.
            named = re.search(r"member (\d+):", why)
            missed = [int(named[1]) if named else 0]
        for k in missed:
            q, mu = logged(rows[k], "initial_")
            given = {"attitude": {"quaternion": [float(x) for x in q]}, "momentum": {"body": [float(x) for x in mu]}}
            member = {**scene, "initial": given}
            if summary:
                doubles = Reference(Taylor(scene, rounded=True), q, mu, seconds)
                told += f"; member {k} {errors[k]:.1e}, {doubles.error(matrix(ends[k][0]), ends[k][1]):.1e} with the inertia as doubles"
                told += f", fine runs {' '.join(f'{e:.1e}' for e in fine_errors(program, name, member, references[k]))}"
            else:
                verdict, rest = judge(program, name, member, references[k], target, why)
                told += f" {verdict}: {figures(references[k])}, {rest}"
        tally[f"{target:.0e}", verdict] += 1
        print(f"{told} ({took:.1f} s)", flush=True)
        program.drop(name)


METHODS = [
    ({"name": "vpd", "tableau": "gauss2"}, 12), ({"name": "quaternion_gauss", "tableau": "gauss3"}, 5),
    ({"name": "splitting", "order": 4}, 20), ({"name": "vpd", "tableau": "gauss4"}, 3), ({"name": "lgvi", "order": 4}, 20),
    ({"name": "rk_projected", "tableau": "rk8"}, 6), ({"name": "vpd", "tableau": "gauss6"}, 1.5),
    ({"name": "vrkmk", "tableau": "gauss3"}, 5), ({"name": "rkmk", "tableau": "rk4"}, 30), ({"name": "splitting", "order": 8}, 6),
    ({"name": "vpd_lagrangian", "tableau": "gauss3"}, 6), ({"name": "quaternion_gauss", "tableau": "gauss1"}, 40),
]


def estimates(program, made):
    print("\n## Estimates\n")
    verdicts = Counter()
    for number in range(ESTIMATES):
        chance = random.Random(f"{WORD}, estimate {number}")
        name, scene, reference = made[number * len(made) // ESTIMATES]
        method, steps_a_radian = METHODS[number % len(METHODS)]
        steps = math.ceil(steps_a_radian * between(chance, 0.5, 4) * reference.fastest * reference.seconds)
        name = f"{name}-estimate"
        summary, why, took = program.run(name, fixed(scene, method, steps, reference.seconds), "--error")
        told = f"{name} {method['name']} {method.get('tableau', method.get('order'))}, {steps} steps"
        if summary:
            error = at_end(reference, summary)
            rest, verdict = of_claim(summary, error)
            rest = f"{error:.1e} true, {rest}; {figures(reference)}"
            if "WRONG" in verdict:
                doubles = as_doubles(program, f"{name}-start", scene, reference.seconds)
                rest += f"; {at_end(doubles, summary):.1e} from the start and with the inertia as doubles have them"
        else:
            verdict, rest = "refused", f"{why}; {figures(reference)}"
        verdicts[verdict] += 1
        print(f"{told} {verdict}: {rest} ({took:.1f} s)", flush=True)
        program.drop(name)
    return verdicts


def table(title, lines, counts):
    """Of counts by line and kind."""
    kinds = sorted({key[-1] for key in counts})
    print(f"\n| {title} | " + " | ".join(kinds) + " |\n|---|" + "---|" * len(kinds))
    for line in lines:
        print(f"| {line} | " + " | ".join(str(counts[line, kind]) for kind in kinds) + " |")


def main():
    folder = Path(sys.argv[2]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    program = Program(Path(sys.argv[1]).resolve(), folder)
    print(f"heyoka {hy.__version__}, {np.finfo(REAL).nmant + 1} bits")
    tallies = {part: Counter() for part in ("scenes", "at the edge", "long", "ensembles")}
    made = scenes(program, tallies["scenes"])
    at_the_edge(program, tallies["at the edge"])
    long(program, tallies["long"])
    ensembles(program, tallies["ensembles"])
    of_estimates = estimates(program, made)
    targets = [f"{target:.0e}" for target in TARGETS]
    for part, tally in tallies.items():
        table(part, targets, Counter({key: count for key, count in tally.items() if key[0] in targets}))
    shares = Counter()
    for tally in tallies.values():
        shares.update({key[1:]: count for key, count in tally.items() if key[0] == "share"})
    table("the rounding of the start takes at most", SHARES, shares)
    claims = Counter()
    for tally in tallies.values():
        claims.update({key[1]: count for key, count in tally.items() if key[0] == "--error"})
    print(f"\n`--error`, of accepted runs: {dict(claims)}; of methods and steps: {dict(of_estimates)}")


if __name__ == "__main__":
    main()

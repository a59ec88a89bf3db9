"""Does vpd take bodies at rest? Scenes that start there, nearly there, or come there, by every method for driven bodies.

    python3 tests/trials/rest.py

500 scenes with n = 2 to 8. The right end is a closed form where the body turns in one plane of its axes, and elsewhere that of
scipy's DOP853, from knot to knot, for g' = g Omega, mu' = [mu, Omega] + F, mu_ij = (d_i + d_j) Omega_ij. Where there is a closed
form, DOP853 is held against it too.

None fails; each end is right: to 1e-6 by methods of order four, to 1e-9 by those of a higher order, to the accuracy asked for by
`accuracy`. Of a scene whose start is below the smallest size, the field is named.
"""

import math
import random
from collections import Counter

import numpy as np
from scipy.integrate import solve_ivp

from trial import Program, arguments, distance, end_of, leave, norm, stretches

# What is asked for, and the largest error that is right.
METHODS = [
    ({"method": {"name": "vpd", "tableau": "gauss2"}}, 1e-6),
    ({"method": {"name": "vpd", "tableau": "gauss3"}}, 1e-9),
    ({"method": {"name": "vpd_lagrangian", "tableau": "gauss2"}}, 1e-6),
    ({"method": {"name": "vrkmk", "tableau": "gauss2"}}, 1e-6),
    ({"method": {"name": "vrkmk_projected", "tableau": "gauss3"}}, 1e-9),
    ({"method": {"name": "rkmk", "tableau": "rk4"}}, 1e-6),
    ({"method": {"name": "rk", "tableau": "rk4"}}, 1e-6),
    ({"method": {"name": "rk_projected", "tableau": "rk8"}}, 1e-9),
    ({}, 1e-6),
    ({"accuracy": {"error": 1e-8}}, 1e-8),
]
STARTS = ["zero", "tiny", "plane", "brake"]
FORCES = ["none", "rising", "faint", "constant", "viscous", "of_momentum", "damped_out", "spring", "field"]
STEPS_PER_S = 64
# The smallest torque and the smallest velocity that vpd takes.
SMALLEST_TORQUE, SMALLEST_VELOCITY = 1e-30, 1e-15


def hat(v):
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def skew(momentum):
    """The skew matrix of a momentum as vpd writes it: for n = 3 a vector."""
    return hat(momentum) if np.ndim(momentum) == 1 else np.array(momentum)


class Body:
    """A random scene, with all that its right end needs."""

    def __init__(self, seed, k):
        rng = self.rng = random.Random(f"rest {seed} {k}")
        asked, self.allowed = METHODS[k % len(METHODS)]
        # Each method meets each start with each force.
        start = STARTS[k // len(METHODS) % len(STARTS)]
        force = FORCES[k // (len(METHODS) * len(STARTS)) % len(FORCES)] if k < 360 else rng.choice(FORCES)
        self.what = f"{start}, {force}"
        self.n = n = rng.choice([2, 3, 3, 4, 5, 6, 7, 8])
        d = np.array([rng.uniform(0.2, 1.0) for _ in range(n)])
        self.sums = d[:, None] + d[None, :]
        self.duration_s = 80.0 if force == "damped_out" else 4.0
        turn = np.linalg.qr(np.array([[rng.gauss(0, 1) for _ in range(n)] for _ in range(n)]))[0]
        turn[:, 0] *= np.linalg.det(turn)
        self.g = turn if rng.random() < 0.5 else np.eye(n)
        self.mu = np.zeros((n, n))
        self.plane = sorted(rng.sample(range(n), 2))
        # [(skew matrix, table)] in the body, [skew matrix] in space, c_ij, rate, [(body point, position, stiffness, table)]
        self.tables, self.in_space, self.viscous, self.of_momentum, self.springs = [], [], np.zeros((n, n)), 0.0, []

        inertia = {"second_moments": d.tolist()}
        if n == 3 and rng.random() < 0.5:
            inertia = {"principal": [d[1] + d[2], d[2] + d[0], d[0] + d[1]]}
        self.scene = {"inertia": inertia, "torques": [], "potential": [], "driven": [], "initial": {}}
        if self.g is turn:
            self.scene["initial"]["attitude"] = {"matrix": turn.tolist()}
        getattr(self, f"start_{start}")()
        getattr(self, f"force_{force}")()
        self.scene = {key: value for key, value in self.scene.items() if value != []}
        self.scenario = {"name": f"rest-{seed}-{k}", "scene": self.scene, "duration_s": self.duration_s}
        self.scenario |= {"log": {"channels": ["/state"]}} | asked | ({} if "accuracy" in asked else {"step_s": 1 / STEPS_PER_S})
        if k % 8 == 5:
            self.scenario["ensemble"] = {"members": 3, "seed": k, "attitude_spread_rad": 0.1, "momentum_spread": 0.0}
            self.what += ", ensemble"

    def given(self, matrix):
        """A skew matrix as a scenario has it: for n = 3 sometimes as a vector."""
        vector = self.n == 3 and self.rng.random() < 0.5
        return [matrix[2, 1], matrix[0, 2], matrix[1, 0]] if vector else matrix.tolist()

    def along(self):
        """In the plane in which the body turns, or anywhere."""
        a = np.zeros((self.n, self.n))
        if self.rng.random() < 0.5:
            a[tuple(self.plane)] = self.rng.choice([-1.0, 1.0])
        else:
            a[np.triu_indices(self.n, 1)] = [self.rng.uniform(-0.5, 0.5) for _ in range(self.n * (self.n - 1) // 2)]
        return a - a.T

    # Starts.

    def start_zero(self):
        if self.rng.random() < 0.5:
            kind = self.rng.choice(["momentum", "angular_velocity"])
            self.scene["initial"][kind] = {"body": self.given(self.mu)}

    def start_tiny(self):
        """The smallest velocity in one plane, and in the others numbers below the smallest normal one."""
        a = np.zeros((self.n, self.n))
        a[np.triu_indices(self.n, 1)] = [self.rng.choice([0.0, 5e-324, 1e-310]) for _ in range(self.n * (self.n - 1) // 2)]
        a[tuple(self.plane)] = SMALLEST_VELOCITY
        self.mu = self.sums * (a - a.T)
        self.scene["initial"]["angular_velocity"] = {"body": self.given(a - a.T)}

    def start_plane(self, rate_rad_s=None):
        self.mu[tuple(self.plane)] = rate_rad_s or self.rng.uniform(-1, 1)
        self.mu = self.sums * (self.mu - self.mu.T)
        self.scene["initial"]["momentum"] = {"body": self.given(self.mu)}

    def start_brake(self):
        """A torque from 0.5 s on that has stopped the body by 1.5 s, if nothing else is there."""
        self.start_plane()
        end = self.duration_s
        table = {"times_s": [0, 0.5, 0.5, 1.5, 1.5, end], "values": [0, 0, -1, -1, 0, 0], "interpolation": "linear"}
        if self.rng.random() < 0.5:
            table = {"times_s": [0, 0.5, 1.5, end], "values": [0, -1, 0, 0], "interpolation": "hold"}
        self.push(self.mu, table)

    # Forces.

    def push(self, along, table):
        self.tables.append((along, table))
        self.scene["torques"].append({"table": {"along": {"body": self.given(along)}, "table": table}})

    def force_none(self):
        pass

    def force_rising(self):
        """Nothing at first; then a torque rises."""
        end, kind = self.duration_s, self.rng.choice(["linear", "monotone"])
        late = self.rng.choice([0.0, 1.0, 1 / 3])
        times, values = ([0, late, end], [0, 0, 1]) if late else ([0, 1.7, end], [0, 0.2, 1])
        self.push(self.along(), {"times_s": times, "values": values, "interpolation": kind})

    def force_faint(self):
        a = np.zeros((self.n, self.n))
        a[tuple(self.plane)] = 1.0
        table = {"times_s": [0, self.duration_s], "values": [SMALLEST_TORQUE, SMALLEST_TORQUE], "interpolation": "linear"}
        self.push(a - a.T, table)

    def force_constant(self):
        a, in_space = 0.3 * self.along(), self.rng.random() < 0.3
        if in_space:
            self.in_space.append(a)
        else:
            self.tables.append((a, {"times_s": [0, self.duration_s], "values": [1, 1], "interpolation": "hold"}))
        self.scene["torques"].append({"constant": {"space" if in_space else "body": self.given(a)}})

    def force_viscous(self):
        c = np.full((self.n, self.n), self.rng.uniform(0.1, 2))
        viscous = {"coefficient": c[0, 0]}
        if self.rng.random() < 0.5:
            c = np.array([[self.rng.uniform(0.1, 2) for _ in range(self.n)] for _ in range(self.n)])
            c = c + c.T
            viscous = {"coefficients": c.tolist()}
        self.viscous = c
        self.scene["torques"].append({"viscous": viscous})

    def force_of_momentum(self, rate_per_s=None):
        self.of_momentum = rate_per_s or self.rng.uniform(0.1, 2)
        self.scene["torques"].append({"of_momentum": {"rate_per_s": self.of_momentum}})

    def force_damped_out(self):
        """The momentum falls by e^-800: no double has it at the end."""
        self.force_of_momentum(10.0)

    def force_spring(self):
        """As short as it can be."""
        y = np.array([self.rng.uniform(-1, 1) for _ in range(self.n)])
        position = self.g @ y * self.rng.choice([1.0, 2.0])
        stiffness = self.rng.uniform(0.1, 1)
        self.springs.append((y, position, stiffness, None))
        spring = {"kind": "spring", "stiffness": stiffness, "body_point": y.tolist(), "position": position.tolist()}
        self.scene["potential"].append(spring)

    def force_field(self):
        """A field that is not there at first."""
        y, direction = ([self.rng.uniform(-1, 1) for _ in range(self.n)] for _ in range(2))
        end = self.duration_s
        table = {"times_s": [0, 1, end], "values": [0, 0, 1], "interpolation": self.rng.choice(["linear", "monotone"])}
        self.springs.append((np.array(y), -np.array(direction), 1.0, table))
        term = {"kind": "uniform", "weight": 1.0, "body_point": y, "direction": direction}
        self.scene["driven"].append({"term": term, "factor": {"table": table}})

    # The right end.

    def stretches(self):
        """[(start_s, end_s, cubics of the torques, cubics of the factors)]"""
        factors = [table for _, _, _, table in self.springs if table]
        cut = stretches([table for _, table in self.tables] + factors, self.duration_s)
        return [(start, end, cubics[: len(self.tables)], cubics[len(self.tables) :]) for start, end, cubics in cut]

    def by_steps(self):
        """(end, largest momentum) by DOP853."""
        n, g, mu = self.n, self.g, self.mu
        largest = norm(mu)
        for start, end, cubics, factors in self.stretches():
            length = end - start
            pushes = [(a, c) for (a, _), c in zip(self.tables, cubics) if any(c)]
            most = sum(norm(a) * sum(abs(x) * length**i for i, x in enumerate(c)) for a, c in pushes)
            most += sum(norm(a) for a in self.in_space)
            pull = sum(stiffness * np.linalg.norm(y) * np.linalg.norm(z) for y, z, stiffness, _ in self.springs)
            most += pull
            # Forces that cancel leave their rounding: a momentum is not known better than in parts of what they could give.
            largest = max(largest, pull * length)
            # The momentum in parts of a size of its own: of a tiny one too each digit counts.
            unit = norm(mu) + most * length or 1.0

            def slope(s, state):
                g, mu = state[: n * n].reshape(n, n), state[n * n :].reshape(n, n)
                omega = unit * mu / self.sums
                force = -self.viscous * omega / unit - self.of_momentum * mu
                for a, c in pushes:
                    force += (c[0] + s * (c[1] + s * (c[2] + s * c[3]))) * (a / unit)
                for a in self.in_space:
                    force += g.T @ (a / unit) @ g
                for y, z, stiffness, table in self.springs:
                    # A spring of rest length 0 pulls as a field towards its position; so does a field.
                    c = factors[0] if table else (1, 0, 0, 0)
                    pull = g.T @ z * (stiffness * (c[0] + s * (c[1] + s * (c[2] + s * c[3]))) / unit)
                    force += np.outer(pull, y) - np.outer(y, pull)
                return np.concatenate([(g @ omega).ravel(), (mu @ omega - omega @ mu + force).ravel()])

            state = np.concatenate([g.ravel(), mu.ravel() / unit])
            done = solve_ivp(slope, (0.0, length), state, "DOP853", rtol=1e-13, atol=1e-14)
            assert done.success, done.message
            g, mu = done.y[: n * n, -1].reshape(n, n), unit * done.y[n * n :, -1].reshape(n, n)
            largest = max(largest, *(norm(unit * x.reshape(n, n)) for x in done.y[n * n :].T))
        return (g, mu), largest

    def in_one_plane(self):
        """(end, largest momentum at a knot) in closed form; None if the body leaves the plane, or forces of space turn it."""
        others = np.ones((self.n, self.n), bool)
        others[tuple(self.plane)] = others[tuple(self.plane[::-1])] = False
        straight = all(c[2] == c[3] == 0 for _, _, cubics, _ in self.stretches() for c in cubics)
        leaves = (np.abs(self.mu[others]) > 1e-300).any() or any(a[others].any() for a, _ in self.tables)
        if self.in_space or self.springs or leaves or not straight:
            return None
        at = tuple(self.plane)
        rate = self.viscous[at] / self.sums[at] + self.of_momentum
        angle, mu, largest = 0.0, self.mu[at], abs(self.mu[at])
        for start, end, cubics, _ in self.stretches():
            s = end - start
            f0, f1 = (sum(a[at] * c[i] for (a, _), c in zip(self.tables, cubics)) for i in (0, 1))
            if rate == 0:
                angle += s * (mu + s * (f0 / 2 + s * f1 / 6)) / self.sums[at]
                mu = mu + s * (f0 + s * f1 / 2)
            else:
                # mu' = f0 + f1 s - rate mu: a line, and what falls towards it.
                line, slope = (f0 - f1 / rate) / rate, f1 / rate
                fallen = -math.expm1(-rate * s)
                angle += ((line + slope * s / 2) * s + (mu - line) * fallen / rate) / self.sums[at]
                mu = line + slope * s + (mu - line) * (1 - fallen if fallen < 0.5 else math.exp(-rate * s))
            largest = max(largest, abs(mu))
        turned, momentum = np.eye(self.n), np.zeros((self.n, self.n))
        i, j = at
        turned[i, i] = turned[j, j] = math.cos(angle)
        turned[i, j], turned[j, i] = math.sin(angle), -math.sin(angle)
        momentum[i, j], momentum[j, i] = mu, -mu
        return (self.g @ turned, momentum), largest


def refusal(program):
    """A start below the smallest size is refused, and the field named."""
    right = True
    for size in (5e-324, 1e-310, 1e-200):
        scene = {"inertia": {"principal": [1, 2, 2.5]}, "initial": {"momentum": {"body": [size, 0, 0]}}}
        _, wrong = program.run({"name": "below", "scene": scene, "step_s": 0.1, "steps": 10})
        named = wrong.startswith("exit 2") and "/scene/initial/momentum/body" in wrong
        print(f"momentum of {size:.0e}: {wrong}")
        right = right and named
    return right


def main():
    given = arguments(__doc__.splitlines()[0], 500).parse_args()
    program = Program(given.vpd, given.failing)
    counts, worst, closed = Counter(), {}, 0
    print(f"{'scene':>6} {'n':>2} {'error':>8} {'allowed':>8} {'DOP853':>8}  asked, start, force: is")
    for k in range(given.members):
        body = Body(given.seed, k)
        (end, largest), own = body.by_steps(), math.nan
        exact = body.in_one_plane()
        if exact:
            closed += 1
            own = distance(exact[0], end, largest)
            assert own < 1e-11, f"scene {k}: closed form and DOP853 differ by {own:.1e}"
            end = exact[0]
        summary, wrong = program.run(body.scenario)
        error = math.nan
        if summary:
            attitude, momentum = end_of(summary)
            error = distance((attitude, skew(momentum)), end, largest)
            verdict = "right" if error <= body.allowed else "WRONG"
            ensemble = summary.get("ensemble", {"members": 1, "succeeded": 1, "body_momentum_deviation": [0.0]})
            # Members differ in their attitudes alone: without forces of space their momenta are the same.
            alike = body.in_space or body.springs or max(ensemble["body_momentum_deviation"]) <= 1e-12 * largest
            if ensemble["succeeded"] < ensemble["members"] or not alike:
                verdict, wrong = "WRONG MEMBERS", str(ensemble)
        else:
            verdict = "FAILED" if wrong.startswith("exit 1") else "REFUSED"
        counts[verdict] += 1
        method = " ".join(body.scenario.get("method", {"": "accuracy" if "accuracy" in body.scenario else "default"}).values())
        worst[method] = max(worst.get(method, 0.0), 0.0 if math.isnan(error) else error)
        if verdict.isupper():
            program.keep(body.scenario, verdict=verdict, said=wrong, error=error, attitude=end[0], body_momentum=end[1])
            figures = f"{k:6} {body.n:2} {error:8.1e} {body.allowed:8.0e} {own:8.1e}"
            print(f"{figures}  {method}, {body.what}: {verdict} {wrong}", flush=True)
    print("largest errors: " + ", ".join(f"{method} {error:.1e}" for method, error in worst.items()))
    print(f"closed form: {closed}, DOP853: {given.members - closed}")
    named = refusal(program)
    counts["starts below the smallest size refused" if named else "STARTS BELOW THE SMALLEST SIZE TAKEN"] += 1
    leave(counts, any(verdict.isupper() for verdict in counts))


if __name__ == "__main__":
    main()

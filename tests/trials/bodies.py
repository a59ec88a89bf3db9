"""Does vpd take what people write of several bodies? Random scenes, right ones and wrong ones, planned and run.

    python3 tests/trials/bodies.py

2,000 scenes with n = 2 to 8 and 1 to 14 bodies: free, pinned and in joints, with terms on one body and between two, by every method that
takes them. A tenth has one fault that was put in.

No command panics or ends by a signal. A fault is refused, and its field named. A right scene is planned in 2 s; of a run that succeeds every
number at the end is there and finite, and by methods that keep the group every attitude is on it; a run that fails has a
code. The estimate of a run is within five times of what it takes, of the processor or by the clock, where either is above 0.1 s.
"""

import json
import math
import random
import resource
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np

from trial import Program, arguments, leave

METHODS = ["vpd", "vpd", "vpd", "auto", "rk_projected", "rkmk", "splitting"]
TABLEAUX = ["gauss1", "gauss2", "gauss3", "gauss4", "gauss8", "rk3"]
PLAN_S, TIMES, SHORT_S, LONG_S, LIMIT_S = 2.0, 5.0, 0.1, 0.25, 120.0


class Scene:
    """A random scene, and the field that is wrong in it, if one is."""

    def __init__(self, seed, number):
        self.rng = rng = random.Random(f"bodies {seed} {number}")
        self.n = rng.choice([3, 3, 3, 3, 2, 4, 5, 8])
        self.count = rng.choice([1, 2, 2, 3, 3, 4, 6, 9, 14])
        self.bodies, self.joints, self.terms = [], [], []
        for a in range(self.count):
            self.add_body(a)
        for _ in range(rng.randint(0, 2 * self.count)):
            self.add_term()
        method = {"name": rng.choice(METHODS)}
        if method["name"] == "splitting" and (self.joints or self.n != 3):
            method["name"] = "vpd"
        if method["name"] == "vpd":
            method["tableau"] = rng.choice(TABLEAUX)
        self.scenario = {
            "name": f"bodies-{number}",
            "scene": {"bodies": self.bodies, "potential": self.terms, "joints": self.joints},
            "method": method,
            "step_s": 10 ** rng.uniform(-3, -0.5),
            "steps": rng.choice([1, 20, 200, 1000, 10000]),
            "log": {"every": rng.choice([1, 5, 100])},
        }
        self.wrong = self.spoil() if rng.random() < 0.1 else None

    def vector(self, scale=1.0):
        """Some entries are nothing, some of another size."""
        rng = self.rng
        size = lambda: rng.choice([0.0, scale, scale, scale * 10 ** rng.randint(-3, 2)])
        return [rng.uniform(-1, 1) * size() for _ in range(self.n)]

    def add_body(self, a):
        rng = self.rng
        hold = rng.choice(["free", "free", "pivot", "joint"])
        size = 10 ** rng.uniform(-2, 1)
        if self.n == 3 and rng.random() < 0.8:
            inertia = {"principal": [size, size * rng.uniform(0.6, 1.4), size * rng.uniform(0.5, 1.5)]}
        else:
            inertia = {"second_moments": [10 ** rng.uniform(-2, 1) for _ in range(self.n)]}
        body = {"name": f"b{a}", "mass": 10 ** rng.uniform(-2, 2), "inertia": inertia, "initial": {}}
        start = body["initial"]
        if self.n == 3:
            if rng.random() < 0.7:
                start["angular_velocity"] = {rng.choice(["body", "space"]): [rng.uniform(-3, 3) for _ in range(3)]}
            if rng.random() < 0.5:
                axis = [rng.uniform(-1, 1), 1, 0]
                start["attitude"] = {"axis_angle": {"axis": axis, "angle_rad": rng.uniform(-3, 3)}}
        if hold == "pivot":
            body["pivot"] = self.vector(3.0)
        elif hold == "joint":
            parent = "space" if a == 0 or rng.random() < 0.3 else f"b{rng.randrange(a)}"
            self.joints.append({"kind": "ball", "between": [parent, f"b{a}"], "points": [self.vector(), self.vector()]})
        else:
            start["position"] = [rng.uniform(-4, 4) * (a + 1) for _ in range(self.n)]
            if rng.random() < 0.5:
                start["velocity"] = self.vector()
        self.bodies.append(body)

    def add_term(self):
        rng = self.rng
        one = {"body": f"b{rng.randrange(self.count)}"}
        kinds = ["uniform", "spring", "point_source"] + ["gravity_gradient"] * (self.n == 3)
        if self.count > 1 and rng.random() < 0.5:
            one = {"between": [f"b{a}" for a in rng.sample(range(self.count), 2)]}
            kinds = ["spring", "point_source"] + ["mutual_gravity"] * (self.n == 3)
        kind = rng.choice(kinds)
        fields = {
            "uniform": lambda: {"weight": rng.uniform(-10, 10), "direction": [0] * (self.n - 1) + [1]},
            "spring": lambda: {"stiffness": 10 ** rng.uniform(-2, 2), "rest_length": rng.choice([0, rng.random()])},
            "point_source": lambda: {"strength": rng.uniform(-1, 1)},
            "gravity_gradient": lambda: {"strength": rng.uniform(-1, 1), "direction": [1, 0, 0]},
            "mutual_gravity": lambda: {"constant": 10 ** rng.uniform(-3, 0)},
        }[kind]()
        if "between" in one and kind != "mutual_gravity":
            fields["points"] = [self.vector(), self.vector()]
        elif "body" in one and kind != "gravity_gradient":
            fields["body_point"] = self.vector()
            if kind != "uniform":
                fields["position"] = self.vector(5.0)
        self.terms.append({"kind": kind, **one, **fields})

    def spoil(self):
        """One fault; the pointer of the field that is wrong, or of what it is in."""
        rng, scene = self.rng, self.scenario["scene"]
        a = rng.randrange(self.count)
        body, at = self.bodies[a], f"/scene/bodies/{a}"
        faults = {
            "unknown body": lambda: (scene["potential"].append({"kind": "spring", "body": "nobody", "body_point": self.vector(),
                "position": self.vector(), "stiffness": 1}), f"/scene/potential/{len(self.terms) - 1}"),
            "itself": lambda: (scene["potential"].append({"kind": "spring", "between": ["b0", "b0"], "stiffness": 1,
                "points": [self.vector(), self.vector()]}), f"/scene/potential/{len(self.terms) - 1}"),
            "its own parent": lambda: (scene["joints"].append({"kind": "ball", "between": [body["name"]] * 2,
                "points": [self.vector(), self.vector()]}), "/scene/joints/"),
            "mass": lambda: (body.update(mass=-1.0), f"{at}/mass"),
            "no moment": lambda: (body.update(inertia={"second_moments": [0.0] * self.n}), f"{at}/inertia"),
            "another n": lambda: (body.update(inertia={"second_moments": [1.0] * (self.n + 1)}), "/scene/bodies/"),
            "pinned and moved": lambda: (body.update(pivot=self.vector(), initial={"position": [1.0] * self.n}), "/scene/"),
            "short point": lambda: (scene["potential"].append({"kind": "uniform", "body": "b0", "weight": 1, "body_point": [1.0],
                "direction": self.vector()}), f"/scene/potential/{len(self.terms) - 1}"),
            "two names alike": lambda: (self.bodies.append(dict(body)), "/scene/bodies/"),
            "driven": lambda: (scene.update(torques=[{"viscous": {"coefficient": 1.0}}]), "/scene/"),
        }
        self.fault = rng.choice(list(faults))
        return faults[self.fault]()[1]


class Trial:
    def __init__(self, given):
        self.program = Program(given.vpd, given.failing)
        self.log = Path(self.program.folder.name) / "run.mcap"
        self.counts, self.reasons, self.slowest_s, self.ratios = Counter(), Counter(), 0.0, []

    def ask(self, scenario, *words):
        """(exit code, stdout, stderr, seconds of the processor)."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(self.program.command(*words), input=json.dumps(scenario), capture_output=True, text=True, timeout=LIMIT_S)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        return done.returncode, done.stdout, done.stderr, spent

    def verdict(self, scene):
        """(a word, in capitals if a promise is broken; what was seen)."""
        code, out, said, spent = self.ask(scene.scenario, "plan", "-", "--json")
        first = (said.strip() or "no word").splitlines()[0]
        if "panicked" in said or code not in (0, 2):
            return "PLAN PANICS", f"exit {code}: {said[-300:]}"
        if scene.wrong:
            named = code == 2 and scene.wrong in first
            return ("fault refused", "") if named else ("FAULT TAKEN", f"{scene.fault} at {scene.wrong}, exit {code}: {first}")
        if code == 2:
            self.reasons[" ".join(word for word in first.split()[2:] if not any(c.isdigit() for c in word))] += 1
            return ("refused", "") if "/scene" in first or "/step" in first else ("REFUSED WITHOUT A FIELD", first)
        self.slowest_s = max(self.slowest_s, spent)
        if spent > PLAN_S:
            return "SLOW PLAN", f"{spent:.1f} s"
        expected = json.loads(out)["run_s"]
        if expected > LONG_S:
            # As long as shows what there is to see.
            scene.scenario["steps"] = max(1, int(scene.scenario["steps"] * LONG_S / expected))
            expected = json.loads(self.ask(scene.scenario, "plan", "-", "--json")[1])["run_s"]
        try:
            code, out, said, spent = self.ask(scene.scenario, "run", "-", "--json", "--force", "-o", str(self.log))
        except subprocess.TimeoutExpired:
            return "NO END", f"expected {expected:.1f} s"
        if "panicked" in said or code not in (0, 1):
            return "RUN PANICS", f"exit {code}: {said[-300:]}"
        summary = json.loads(out)
        if summary["outcome"] == "failed":
            return f"failed: {summary['diagnosis']['code']}", ""
        bodies = summary["final"]["bodies"]
        numbers = [np.array(x, float).ravel() for body in bodies.values() for x in body.values() if x is not None]
        if len(bodies) != scene.count or not all(np.isfinite(x).all() for x in numbers):
            return "NOT A NUMBER", ""
        off = max(np.abs(g.T @ g - np.eye(scene.n)).max() for g in (np.array(body["attitude"]) for body in bodies.values()))
        if off > 1e-13:
            return "OFF THE GROUP", f"{off:.1e}"
        if max(spent, expected) > SHORT_S:
            # An estimate times the first steps by the clock: other work makes it longer, or the run, or both.
            ratio = min((spent / expected, summary["wall_s"] / expected), key=lambda ratio: abs(math.log(ratio)))
            self.ratios.append(ratio)
            if not 1 / TIMES <= ratio <= TIMES:
                return "ESTIMATE", f"expected {expected:.2f} s, took {spent:.2f} s, {summary['wall_s']:.2f} s by the clock"
        return "succeeded", ""


def main():
    given = arguments(__doc__.splitlines()[0], 2000).parse_args()
    trial = Trial(given)
    for number in range(given.members):
        scene = Scene(given.seed, number)
        verdict, seen = trial.verdict(scene)
        trial.counts[verdict] += 1
        if verdict.isupper():
            trial.program.keep(scene.scenario, verdict=verdict, seen=seen)
            print(f"{number:6} n {scene.n}, {scene.count} bodies, {scene.scenario['method']}: {verdict} {seen}", flush=True)
        if (number + 1) % 100 == 0:
            print(f"{number + 1:6} {dict(trial.counts)}", flush=True)
    for reason, count in trial.reasons.most_common():
        print(f"refused {count}: {reason}")
    ratios = sorted(trial.ratios) or [math.nan]
    middle = ratios[len(ratios) // 2]
    print(f"slowest plan {trial.slowest_s:.2f} s; run against estimate, of {len(trial.ratios)}: least {ratios[0]:.2f}, middle {middle:.2f}, most {ratios[-1]:.2f}")
    leave(trial.counts, any(verdict.isupper() for verdict in trial.counts))


if __name__ == "__main__":
    main()

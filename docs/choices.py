"""What `accuracy` chooses next to the best of a grid: the time of the chosen run over that of the cheapest which is as exact.

    python3 docs/choices.py target/release/vpd [SCENES [SEED]]

Random bodies with n = 3 (two of three scenes) and n = 4, 5, 8, with springs, fields, point sources, or free; errors of 1e-4 to 1e-10.
Each method on the grid takes steps that fall by 2^(1/4) until the error is reached; the error of all is the distance of their
ends from that of eight stages with small steps. Times are the integrator's own, with a sample at both ends, the least of
nine runs of the chosen method and of the three that were the quickest on the grid, in turns. Needs an idle machine.
"""

import json
import math
import random
import subprocess
import sys
import tempfile
from pathlib import Path

TURNS = 9
FINER = 2**-0.25
EXPLICIT = [("rk_projected", tableau) for tableau in ("rk4", "rk8")] + [("rkmk", tableau) for tableau in ("rk4", "rk8")]
ANY_N = EXPLICIT + [("vpd", f"gauss{stages}") for stages in (8, 6, 4, 3, 2, 1)]
THREE = [("quaternion_gauss", f"gauss{stages}") for stages in (8, 6, 4, 3, 2)] + ANY_N
THREE += [("splitting", order) for order in (2, 4, 6, 8)] + [("lgvi", order) for order in (2, 4, 8)]


def method(name, detail):
    return {"name": name, "order" if isinstance(detail, int) else "tableau": detail}


class Bench:
    def __init__(self, program, folder):
        self.program, self.folder = Path(program).resolve(), Path(folder)

    def ask(self, command, scenario, *more):
        path = self.folder / "scenario.json"
        path.write_text(json.dumps(scenario))
        done = subprocess.run([self.program, command, path, "--json", *more], capture_output=True, text=True)
        return json.loads(done.stdout) if done.stdout else None

    def run(self, scenario, of, step_s, steps):
        """The end of a run and its seconds; None if it fails."""
        whole = scenario | {"method": of, "step_s": step_s, "steps": steps, "log": {"every": steps, "channels": ["/state"]}}
        summary = self.ask("run", whole, "-o", self.folder / "run.mcap", "--force")
        if not summary or summary["outcome"] != "succeeded":
            return None
        return summary["final"], summary["ns_per_step"] * 1e-9 * steps


def flat(value):
    return [x for row in value for x in flat(row)] if isinstance(value, list) else [value]


def distance(a, b, n):
    """As the program defines it: of the attitude, plus of the momentum relative to its size."""
    def half(key):
        # A vector is that of a skew matrix with n = 3, which has each number twice.
        twice = 1.0 if key == "body_momentum" and n == 3 else 0.5
        return math.sqrt(twice * sum((x - y) ** 2 for x, y in zip(flat(a[key]), flat(b[key]))))
    size = math.sqrt((1.0 if n == 3 else 0.5) * sum(x * x for x in flat(b["body_momentum"])))
    return half("attitude") + half("body_momentum") / size


def scene(draw, n):
    vector = lambda size: [draw.gauss(0, size) for _ in range(n)]
    initial = {}
    if n == 3:
        low, middle = sorted(draw.uniform(0.5, 2.0) for _ in range(2))
        inertia = {"principal": [low, middle, draw.uniform(max(middle - low, 0.6 * middle), 0.98 * (low + middle))]}
        initial["angular_velocity"] = {"body": vector(1.0)}
        initial["attitude"] = {"axis_angle": {"axis": vector(1.0), "angle_rad": draw.uniform(0, 3)}}
    else:
        inertia = {"second_moments": [draw.uniform(0.5, 2.0) for _ in range(n)]}
        skew = [[0.0] * n for _ in range(n)]
        for i in range(n):
            for j in range(i):
                skew[i][j] = draw.gauss(0, 1.0)
                skew[j][i] = -skew[i][j]
        initial["angular_velocity"] = {"body": skew}
    potential = []
    for _ in range(draw.randint(0, 2)):
        kind = draw.choice(["uniform", "spring"])
        if kind == "uniform":
            potential.append({"kind": kind, "weight": draw.uniform(0.5, 3), "body_point": vector(0.7), "direction": vector(1.0)})
        else:
            potential.append({"kind": kind, "stiffness": draw.uniform(0.5, 3), "rest_length": draw.uniform(0.5, 1.5),
                              "body_point": vector(0.7), "position": vector(2.0)})
    return {"inertia": inertia, "potential": potential, "initial": initial}


def main():
    program = sys.argv[1]
    given = sys.argv[2:]
    count, seed = map(int, given + ["24", "1"][len(given):])
    draw, ratios = random.Random(seed), {"n = 3": [], "n > 3": []}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(program, folder)
        for number in range(count):
            n = 3 if number % 3 else draw.choice([4, 5, 8])
            error, duration_s = draw.choice([1e-4, 1e-6, 1e-8, 1e-10]), draw.uniform(5, 40)
            scenario = {"name": "choice", "scene": scene(draw, n)}
            plan = bench.ask("plan", scenario | {"accuracy": {"error": error}, "duration_s": duration_s,
                                                 "log": {"every": 10**6, "channels": ["/state"]}})
            if not plan or "advice" not in plan:
                print(f"{number:3} n = {n}: refused, {json.dumps(plan)[:150]}", flush=True)
                continue
            form = plan["formulation"]
            chosen = (form["method"], form["tableau"] if form["tableau"] else form["order"])
            fine = 2 ** math.ceil(math.log2(duration_s / 0.02))
            known = bench.run(scenario, method("vpd", "gauss8"), duration_s / fine, fine)[0]

            def reached(of, steps, known=known, n=n, scenario=scenario, duration_s=duration_s):
                made = bench.run(scenario, of, duration_s / steps, steps)
                return made and (distance(made[0], known, n), made[1])

            found, least = [], math.inf
            for of in (method(*each) for each in (THREE if n == 3 else ANY_N)):
                steps = duration_s / 1.0
                # Coarse, then fine: the least steps with which it is exact enough.
                while not ((made := reached(of, math.ceil(steps))) and made[0] <= error):
                    steps *= 2
                    # It can be the best no more.
                    if steps > 2e5 or made and made[1] > 2 * least:
                        made = None
                        break
                if not made:
                    continue
                while steps > 1 and (made := reached(of, math.ceil(steps * FINER))) and made[0] <= error:
                    steps *= FINER
                found.append((reached(of, math.ceil(steps))[1], of, math.ceil(steps)))
                least = min(least, found[-1][0])
            found.sort(key=lambda entry: entry[0])
            mine = (None, method(*chosen), plan["steps"])
            if chosen[0] not in {of for of, _ in THREE}:
                mine = None
            best = {}
            for _ in range(TURNS):
                for at, (_, of, steps) in enumerate([mine or found[0], *found[:3]]):
                    made = reached(of, steps)
                    best[at] = min(best.get(at, math.inf), made[1]) if made else math.inf
            cheapest = min((best[at], at) for at in range(1, 1 + len(found[:3])))
            own = reached(method(*chosen), plan["steps"]) if mine else None
            ratio = best[0] / cheapest[0]
            _, of, steps = found[cheapest[1] - 1]
            if mine:
                ratios["n = 3" if n == 3 else "n > 3"].append(ratio)
            print(f"{number:3} n = {n}, {error:.0e}, {duration_s:4.1f} s, {len(scenario['scene']['potential'])} terms: "
                  f"{chosen[0]} {chosen[1]} with {plan['steps']} steps, error {own[0] if own else math.nan:.1e}; best {of['name']} "
                  f"{of.get('tableau', of.get('order'))} with {steps}: {ratio:.2f}" + ("" if mine else " (not compared)"), flush=True)
    for name, all_ in ratios.items():
        all_.sort()
        if all_:
            print(f"{name}: {len(all_)} scenes, median {all_[len(all_) // 2]:.2f}, nine of ten {all_[int(0.9 * (len(all_) - 1))]:.2f}, "
                  f"worst {all_[-1]:.2f}")


if __name__ == "__main__":
    main()

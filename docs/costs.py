"""The planned cost of a step next to its measured time, for the methods that `accuracy` chooses.

    python3 docs/costs.py target/release/vpd [SCENES [SEED]]

The scenes of choices.py with n = 3, 4, 5, 8 and errors of 1e-4 to 1e-10; every second asks for a symplectic method. The table of
costs was made on other machines, and one that others use too changes its pace within seconds. So the time of a step is measured
in units of three fixed runs just before and after it, median of nine, and ratios are divided by their median.
"""

import random
import statistics
import sys
import tempfile

from choices import Bench, method, scene

TURNS = 9
# Enough steps for a time, about 30 ms.
LONG_NS, MOST = 3e7, 4000


def main():
    program, *given = sys.argv[1:]
    count, seed = map(int, given + ["36", "77"][len(given):])
    draw, found = random.Random(seed), []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(program, folder)
        fixed = random.Random(5)
        small, large = ({"name": "unit", "scene": scene(fixed, n)} for n in (3, 4))

        def unit():
            """The geometric mean of a step of three kinds, in seconds."""
            runs = [(small, method("quaternion_gauss", "gauss4"), 6000), (large, method("rk_projected", "rk8"), 6000),
                    (large, method("vpd", "gauss4"), 1000)]
            return statistics.geometric_mean(bench.run(at, of, 0.1, steps)[1] / steps for at, of, steps in runs)

        for number in range(count):
            n, error, duration_s = draw.choice([3, 3, 4, 5, 8]), 10**-draw.choice([4, 6, 8, 10]), draw.uniform(5, 40)
            scenario = {"name": "cost", "scene": scene(draw, n)}
            accuracy = {"error": error, "symplectic": number % 2 == 0}
            plan = bench.ask("plan", scenario | {"accuracy": accuracy, "duration_s": duration_s})
            if not plan or "advice" not in plan:
                print(f"{number:3} n = {n}: refused", flush=True)
                continue
            form = plan["formulation"]
            detail = form["tableau"] or form["order"]
            named = form["tableau"] or f"order {form['order']}"
            chosen = next(each for each in plan["advice"]["candidates"]
                          if (each["method"], each["tableau"]) == (form["method"], named))
            step_s = chosen["step_s"]
            planned_ns = 1e3 * chosen["cost_us"] * step_s
            steps = max(plan["steps"], min(MOST, int(LONG_NS / planned_ns)))
            units, before = [], unit()
            for _ in range(TURNS):
                step = bench.run(scenario, method(form["method"], detail), step_s, steps)[1] / steps
                after = unit()
                units.append(step / (0.5 * (before + after)))
                before = after
            found.append((planned_ns / statistics.median(units), n, form["method"], detail, step_s))
            print(f"{number:3} n = {n}: {form['method']} {detail}, step {step_s:.3g} s: {planned_ns:.0f} ns planned, "
                  f"{statistics.median(units):.2f} units", flush=True)
    middle = statistics.median(ratio for ratio, *_ in found)
    off = sorted((max(ratio / middle, middle / ratio), ratio / middle, *of) for ratio, *of in found)
    print(f"{len(off)} choices: planned over measured within {off[int(0.9 * (len(off) - 1))][0]:.2f} for nine of ten, "
          f"{sum(each[0] <= 1.5 for each in off)} within 1.5; the farthest:")
    for _, ratio, n, *of in off[-5:]:
        print(f"  {ratio:.2f} n = {n}: {of[0]} {of[1]}, step {of[2]:.3g} s")


if __name__ == "__main__":
    main()

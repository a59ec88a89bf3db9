"""Sobol's indices of `vpd report` next to those of SALib.

    python3 -m venv venv && venv/bin/pip install SALib==1.6.0 numpy==2.4.6 scipy==1.17.1
    venv/bin/python docs/sobol.py target/release/vpd FOLDER

1. Ishigami's function, whose indices are known, through a stand-in: a sweep over three angles makes the table, and the function of the
   angles is written into its column of a score.
2. A pendulum: its largest speed over tilt, weight and inertia, 8192 rows.

Each is analysed three times: by `vpd report`, by SALib from the same table, and by SALib from rows of its own, which `vpd sweep` runs as
lists. The first two have the same estimators, so they agree to rounding; the third has other values, and must agree within the
intervals of both. The script ends with 1 if one does not.

3. How much the scrambled sequence of the rows is worth: the root mean square error of all indices over 20 seeds, of `vpd` and of
   independent rows, at the same number of members.
"""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from SALib.analyze import sobol
from SALib.sample import sobol as rows_of

PROGRAM, FOLDER = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
TILT = "/scene/initial/attitude/axis_angle/angle_rad"
SCENE = {
    "name": "pendulum",
    "scene": {
        "inertia": {"principal": [1.0, 1.0, 0.2]},
        "potential": [{"kind": "uniform", "weight": 9.8, "body_point": [0, 0, -0.5], "direction": [0, 0, 1]}],
        "initial": {"attitude": {"axis_angle": {"axis": [1, 0, 0], "angle_rad": 0.5}}},
    },
    "method": {"name": "vpd", "tableau": "gauss2"},
    "step_s": 0.02,
    "duration_s": 1.5,
    "log": {"every": 1},
}
# Name, pointer, least and largest value of each field.
PENDULUM = [
    ("tilt", TILT, 0.2, 1.2),
    ("weight", "/scene/potential/0/weight", 9.0, 10.6),
    ("inertia", "/scene/inertia/principal/0", 0.9, 1.1),
]
ANGLES = [
    (f"x{k}", f"/scene/initial/angular_velocity/body/{k}", -np.pi, np.pi) for k in range(3)
]
ISHIGAMI = {"x0": (0.313905, 0.557589), "x1": (0.442411, 0.442411), "x2": (0.0, 0.243684)}


def ishigami(x):
    return np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


def file(name, fields, values, combine, seed=0):
    sweep = {
        "scenario": SCENE if fields is PENDULUM else spinning(),
        "combine": combine,
        "seed": seed,
        "vary": [
            {"name": field, "pointer": pointer, "values": values(k)}
            for k, (field, pointer, _, _) in enumerate(fields)
        ],
        "scores": [{"name": "speed", "measure": {"largest": "angular_speed"}}],
    }
    path = FOLDER / f"{name}.json"
    path.write_text(json.dumps(sweep))
    return path


def spinning():
    scene = json.loads(json.dumps(SCENE))
    scene["scene"]["initial"]["angular_velocity"] = {"body": [1, 1, 1]}
    scene["duration_s"] = 0.02
    return scene


def uniform(fields, rows):
    return lambda k: {"uniform": {"from": fields[k][2], "to": fields[k][3], "count": 2 * rows}}


def table(path):
    """Runs a sweep; of one over angles the score becomes Ishigami's function."""
    out = path.with_suffix(".csv")
    subprocess.run([PROGRAM, "sweep", path, "-o", out, "--force"], check=True, capture_output=True)
    lines = list(csv.DictReader(out.open()))
    if "x0" in lines[0]:
        for line in lines:
            line["speed"] = repr(float(ishigami([float(line[f"x{k}"]) for k in range(3)])))
        with out.open("w", newline="") as text:
            writer = csv.DictWriter(text, lines[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
    return out, np.array([float(line["speed"]) for line in lines])


def of_vpd(path, out):
    told = subprocess.run(
        [PROGRAM, "report", path, "--table", out, "--json"], check=True, capture_output=True
    )
    columns = {column["name"]: column for column in json.loads(told.stdout)["columns"]}
    return {
        field: [(of[kind]["value"], of[kind]["low"], of[kind]["high"]) for kind in ("first", "total")]
        for field, of in columns["speed"]["sobol"].items()
    }


def problem(fields):
    return {
        "num_vars": len(fields),
        "names": [field[0] for field in fields],
        "bounds": [[low, high] for _, _, low, high in fields],
    }


def of_salib(fields, values):
    """values: of each row A, A with field k of B for each k, B."""
    found = sobol.analyze(problem(fields), values, calc_second_order=False, seed=1)
    return {
        field[0]: [
            (found[kind][k], found[kind][k] - found[f"{kind}_conf"][k], found[kind][k] + found[f"{kind}_conf"][k])
            for kind in ("S1", "ST")
        ]
        for k, field in enumerate(fields)
    }


def compared(name, fields, rows):
    path = file(name, fields, uniform(fields, rows), "saltelli")
    out, speeds = table(path)
    ours = of_vpd(path, out)
    # A, B, mixed becomes A, mixed, B.
    blocks = speeds.reshape(rows, -1)
    same = of_salib(fields, np.hstack([blocks[:, :1], blocks[:, 2:], blocks[:, 1:2]]).ravel())
    drawn = rows_of.sample(problem(fields), rows, calc_second_order=False, seed=3)
    listed = file(name + "-own", fields, lambda k: {"list": drawn[:, k].tolist()}, "side_by_side")
    own = of_salib(fields, table(listed)[1])
    good = True
    for field, figures in ours.items():
        for kind, figure, alike, other in zip(("first", "total"), figures, same[field], own[field]):
            agrees = abs(figure[0] - alike[0]) < 1e-9
            # Two intervals of 95 % that do not overlap are apart.
            meets = figure[1] <= other[2] and other[1] <= figure[2]
            known = ISHIGAMI[field][kind == "total"] if fields is ANGLES else None
            meets = meets and (known is None or figure[1] <= known <= figure[2])
            good = good and agrees and meets
            print(
                f"{name:9} {field:8} {kind}  vpd {figure[0]:8.5f} ({figure[1]:.5f} to {figure[2]:.5f})"
                f"  SALib, same table {alike[0] - figure[0]:+.1e}, own rows {other[0]:8.5f} +- {other[2] - other[0]:.5f}"
                + (f"  known {known:.5f}" if known is not None else "")
                + ("" if agrees and meets else "  APART")
            )
    return good


def worth(rows, seeds):
    """The error of the indices of Ishigami's function, of rows of vpd and of independent ones."""
    errors = {"vpd": [], "independent": []}
    truth = np.array([ISHIGAMI[f"x{k}"] for k in range(3)])
    for seed in range(seeds):
        path = file("worth", ANGLES, uniform(ANGLES, rows), "saltelli", seed)
        found = of_vpd(path, table(path)[0])
        errors["vpd"].append(np.array([[x[0] for x in found[f"x{k}"]] for k in range(3)]) - truth)
        a, b = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, 3, rows))
        mixed = [np.array([b[j] if j == k else a[j] for j in range(3)]) for k in range(3)]
        values = np.array([ishigami(x) for x in (a, *mixed, b)]).T
        found = of_salib(ANGLES, values.ravel())
        errors["independent"].append(np.array([[x[0] for x in found[f"x{k}"]] for k in range(3)]) - truth)
    for name, of in errors.items():
        print(f"{rows} rows, {name}: error {np.sqrt(np.mean(np.square(of))):.1e}")


def main():
    FOLDER.mkdir(parents=True, exist_ok=True)
    good = [compared("ishigami", ANGLES, 8192), compared("pendulum", PENDULUM, 8192)]
    for rows in (128, 1000, 1024):
        worth(rows, 20)
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""The tables of docs/paper.md, measured with the program itself.

    python3 docs/figures.py orders|energy|orthogonality|projection|stop|time|baselines

Each word prints one table as Markdown. Only the standard library is used; the program is built first.
"""

import json
import math
import statistics
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VPD = ROOT / "target/release/vpd"
SCENE = ROOT / "scenarios/dipole.json"
REFERENCE = json.loads((ROOT / "solve/tests/data/dipole-reference.json").read_text())["points"]["0.5"]

COMPOSED = ("splitting", "lgvi")
PAIR = ("vpd", "vrkmk")
SIX = 1 / 26
# The runs of the paper: tableau, step, what it says of VPD and of VRKMK.
LONG = (
    ("gauss1", 0.01, "1e-5", "1e-4"),
    ("rk3", 0.01, "1e-6", "1e-7"),
    ("gauss2", 0.01, "1e-9", "1e-9"),
    ("gauss3", SIX, "1e-10", "slow increase"),
)


def run(name, tableau, h, steps, log=None, channel="/energy", every=1, tolerance=None):
    """One run; the summary, and the log at the path given."""
    with tempfile.TemporaryDirectory() as folder:
        path = log or Path(folder) / "run.mcap"
        method = {"name": name}
        if name in COMPOSED:
            method["order"] = int(tableau)
        else:
            method["tableau"] = tableau
        if tolerance:
            method["solver"] = {"tolerance": tolerance}
        fields = {
            "/method": json.dumps(method),
            "/step_s": repr(h),
            "/steps": steps,
            "/log": json.dumps({"every": every, "channels": [channel], "compression": "none"}),
            "/expect": "null",
        }
        words = [word for key, value in fields.items() for word in ("--set", f"{key}={value}")]
        done = subprocess.run(
            [VPD, "run", SCENE, *words, "--json", "--force", "-o", path], capture_output=True, text=True
        )
        if not done.stdout:
            sys.exit(done.stderr)
        return json.loads(done.stdout)


def records(data, at, end):
    """The records of MCAP between two offsets: kind, start, end."""
    while at < end:
        kind, size = struct.unpack_from("<BQ", data, at)
        yield kind, at + 9, at + 9 + size
        at += 9 + size


def doubles(data, field):
    """One double of every message of an uncompressed log of one channel besides /log, in order."""
    wanted = field << 3 | 1
    topics = {}
    for kind, start, end in records(data, 8, len(data) - 8):
        if kind != 6:
            continue
        name = struct.unpack_from("<I", data, start + 28)[0]
        for inner, first, last in records(data, start + 40 + name, end):
            if inner == 4:
                number, _, size = struct.unpack_from("<HHI", data, first)
                topics[number] = data[first + 8 : first + 8 + size]
            elif inner == 5 and topics[struct.unpack_from("<H", data, first)[0]] != b"/log":
                at, value = first + 22, 0.0
                while at < last:
                    if data[at] == wanted:
                        value = struct.unpack_from("<d", data, at + 1)[0]
                    at += 9
                yield value


def series(name, tableau, h, steps, channel, field, every=1, tolerance=None):
    """The summary of a run and one number of each sample of its log."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        summary = run(name, tableau, h, steps, log, channel, every, tolerance)
        return summary, list(doubles(log.read_bytes(), field))


def energy(name, tableau, h, steps=100_000, tolerance=None):
    """The summary and H - H0 of each sample."""
    return series(name, tableau, h, steps, "/energy", 4, tolerance=tolerance)


def worst(values, steps=None):
    return max(abs(value) for value in values[: None if steps is None else steps + 1])


def trend(values):
    """Change over the run by a line through 100 means, and its standard error."""
    size = len(values) // 100
    means = [statistics.fmean(values[i * size : (i + 1) * size]) for i in range(100)]
    centre, level = 49.5, statistics.fmean(means)
    spread = sum((i - centre) ** 2 for i in range(100))
    slope = sum((i - centre) * mean for i, mean in enumerate(means)) / spread
    rest = sum((mean - level - slope * (i - centre)) ** 2 for i, mean in enumerate(means)) / 98
    return 100 * slope, 100 * math.sqrt(rest / spread)


def norm(matrix):
    """Spectral norm of a 3 x 3 matrix, by powers of its Gram matrix."""
    gram = [[sum(row[i] * row[j] for row in matrix) for j in range(3)] for i in range(3)]
    trace = sum(gram[i][i] for i in range(3))
    if trace == 0:
        return 0.0
    power = [[entry / trace for entry in row] for row in gram]
    for _ in range(60):
        power = [[sum(a[k] * power[k][j] for k in range(3)) for j in range(3)] for a in power]
        scale = max(abs(entry) for row in power for entry in row)
        power = [[entry / scale for entry in row] for row in power]
    vector = max(zip(*power), key=lambda column: sum(abs(entry) for entry in column))
    image = [sum(a * b for a, b in zip(row, vector)) for row in matrix]
    return math.hypot(*image) / math.hypot(*vector)


def error(name, tableau, per_unit):
    """|p - p_ref|_2 + |g - g_ref|_2 at t = 0.5, as in the paper."""
    final = run(name, tableau, 1 / per_unit, per_unit // 2)["final"]
    attitude = [
        [ours - float(exact) for ours, exact in zip(row, reference)]
        for row, reference in zip(final["attitude"], REFERENCE["g"])
    ]
    momentum = [a - float(b) for a, b in zip(final["body_momentum"], REFERENCE["ptilde"])]
    return norm(attitude) + math.hypot(*momentum)


def table(head, rows):
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |")


def step(h):
    return "1/26" if h == SIX else f"{h:g}"


def with_error(change):
    return f"{change[0]:+.1e} ± {change[1]:.0e}"


def orders():
    low, six = (10, 20, 40, 80, 160, 320), (10, 14, 20, 26, 40, 52)
    for tableaux, counts, last in ((("gauss1", "rk3", "gauss2"), low, (160, 320)), (("gauss3",), six, (26, 40))):
        rows = []
        for tableau in tableaux:
            for name in PAIR:
                errors = {count: error(name, tableau, count) for count in counts}
                order = math.log(errors[last[0]] / errors[last[1]]) / math.log(last[1] / last[0])
                theory = {"gauss1": 2, "rk3": 3, "gauss2": 4, "gauss3": 6}[tableau]
                rows.append([tableau, name, *(f"{e:.2e}" for e in errors.values()), f"{order:.2f}", f"{theory}"])
        table(["tableau", "method", *(f"1/h = {c}" for c in counts), f"order, {last[0]} to {last[1]}", "paper"], rows)
        print()


def energies():
    rows = []
    for tableau, h, *paper in LONG:
        for name, says in zip(PAIR, paper):
            _, values = energy(name, tableau, h, 1_000_000)
            rows.append(
                [tableau, step(h), name, *(f"{worst(values, n):.2e}" for n in (1000, 10_000, 100_000, 1_000_000))]
                + [with_error(trend(values[:100_001])), with_error(trend(values)), says]
            )
    head = ["tableau", "h", "method", "1e3 steps", "1e4 steps", "1e5 steps", "1e6 steps"]
    table([*head, "change over 1e5", "change over 1e6", "paper"], rows)


def orthogonality():
    names = {"vpd": "machine precision", "vrkmk": "accumulates", "vrkmk_projected": "-"}
    rows = []
    for name, says in names.items():
        _, values = series(name, "gauss3", SIX, 1_000_000, "/orthogonality", 1, every=10)
        rows.append([name, *(f"{worst(values, n // 10):.1e}" for n in (1000, 10_000, 100_000, 1_000_000)), says])
    table(["method", "1e3 steps", "1e4 steps", "1e5 steps", "1e6 steps", "paper"], rows)


def projection():
    rows = []
    for tableau, h, *_ in LONG:
        for name in ("vrkmk", "vrkmk_projected"):
            _, values = energy(name, tableau, h, 1_000_000)
            drift = run(name, tableau, h, 100_000, channel="/momentum")["momentum"]["max_drift"]
            says = {"vrkmk": "slow increase", "vrkmk_projected": "not cured"}[name] if h == SIX else "-"
            rows.append(
                [tableau, step(h), name, f"{worst(values, 100_000):.2e}"]
                + [with_error(trend(values[:100_001])), with_error(trend(values)), f"{drift:.0e}", says]
            )
    head = ["tableau", "h", "method", "largest over 1e5", "change over 1e5", "change over 1e6"]
    table([*head, "momentum drift", "paper"], rows)


def stop():
    rows = []
    for tolerance in (1e-15, 1e-14, 1e-13, 1e-12, 1e-11, 1e-10):
        row = [f"{tolerance:.0e}"]
        for name in ("vpd", "vrkmk", "vrkmk_projected"):
            _, values = energy(name, "gauss3", SIX, tolerance=tolerance)
            row += [f"{worst(values):.1e}", with_error(trend(values))]
        rows.append(row)
    table(["tolerance", "vpd", "change", "vrkmk", "change", "vrkmk_projected", "change"], rows)


def time():
    """Nanoseconds a step, least of five interleaved runs, next to the errors at that step."""
    methods = [(tableau, name) for tableau in ("gauss1", "rk3", "gauss2") for name in PAIR]
    methods += [("gauss2", "quaternion_gauss"), ("4", "splitting"), ("4", "lgvi"), ("rk4", "rkmk")]
    methods += [("gauss3", name) for name in (*PAIR, "quaternion_gauss")]
    counts = {"gauss1": (40, 100, 200), "rk3": (80, 160, 320), "gauss3": (10, 26, 40)}
    cases = [(*method, count) for method in methods for count in counts.get(method[0], (20, 50, 100))]
    least = {}
    for _ in range(5):
        for tableau, name, count in cases:
            done = run(name, tableau, 1 / count, 20_000, channel="/log", every=20_000)
            key = tableau, name, count
            least[key] = min(least.get(key, math.inf), done["ns_per_step"])
    points, rows = {}, []
    for tableau, name, count in cases:
        summary, values = energy(name, tableau, 1 / count, 20_000)
        errors = error(name, tableau, count), worst(values)
        each = least[tableau, name, count]
        points.setdefault((tableau, name), []).append((errors, each * count / 1000))
        rows.append(
            [tableau, name, f"1/{count}", *(f"{e:.1e}" for e in errors)]
            + [f"{summary['solver']['iterations_per_step']:.1f}", f"{each:.0f}", f"{each * count / 1000:.0f}"]
        )
    head = ["tableau, order", "method", "h", "error at t = 0.5", "energy error"]
    table([*head, "sweeps", "ns a step", "µs a unit of time"], rows)
    print()
    targets = {"gauss1": (1e-5, 5e-5), "rk3": (1e-7, 1e-7), "gauss3": (1e-10, 1e-10)}
    rows = []
    for tableau, name in methods:
        row = []
        for which, target in enumerate(targets.get(tableau, (1e-7, 1e-8))):
            ours = points[tableau if (tableau, "vpd") in points else "gauss2", "vpd"]
            cost, unit = (cost_at(line, which, target) for line in (points[tableau, name], ours))
            row += [f"{target:.0e}"] + ([f"{cost:.0f}", f"{cost / unit:.2f}"] if cost else ["-", "-"])
        rows.append([tableau, name, *row])
    head = ["error at t = 0.5", "µs a unit of time", "vpd = 1", "energy error", "µs a unit of time", "vpd = 1"]
    table(["tableau, order", "method", *head], rows)


def cost_at(points, which, target):
    """The cost at an error, on the line in logarithms between the two points around it, if there are such."""
    line = sorted((math.log(errors[which]), math.log(cost)) for errors, cost in points)
    for (x0, y0), (x1, y1) in zip(line, line[1:]):
        if x0 <= math.log(target) <= x1:
            return math.exp(y0 + (y1 - y0) * (math.log(target) - x0) / (x1 - x0))
    return None


def baselines():
    rows = []
    for name, tableau, h in (
        ("vpd", "gauss2", 0.01),
        ("splitting", "4", 0.01),
        ("lgvi", "4", 0.01),
        ("quaternion_gauss", "gauss2", 0.01),
        ("quaternion_gauss", "gauss4", SIX),
        ("vpd", "gauss4", SIX),
        ("quaternion_gauss", "gauss8", 0.2),
        ("vpd", "gauss8", 0.2),
        ("vpd", "gauss8", 0.1),
        ("rk", "rk4", 0.01),
        ("rk_projected", "rk4", 0.01),
        ("rkmk", "rk4", 0.01),
    ):
        summary, values = energy(name, tableau, h)
        if summary["outcome"] != "succeeded":
            found = summary["diagnosis"]
            rows.append([name, tableau, step(h), f"`{found['code']}`, step {found['step']}", "-", "-"])
            continue
        summary = run(name, tableau, h, 100_000, channel="/orthogonality")
        rows.append(
            [name, tableau, step(h), f"{worst(values):.1e}", with_error(trend(values))]
            + [f"{summary['orthogonality']['max']:.1e}"]
        )
    table(["method", "tableau, order", "h", "largest energy error", "change over the run", "orthogonality"], rows)


TABLES = {
    "orders": orders,
    "energy": energies,
    "orthogonality": orthogonality,
    "projection": projection,
    "stop": stop,
    "time": time,
    "baselines": baselines,
}

if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in TABLES:
        sys.exit(__doc__)
    subprocess.run(["cargo", "build", "--release", "--locked", "--quiet"], cwd=ROOT, check=True)
    TABLES[sys.argv[1]]()

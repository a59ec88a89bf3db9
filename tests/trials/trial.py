"""What the trials share: tables over time as polynomials, runs of vpd, the distance of two ends, and the words at the end."""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator


def arguments(about, members):
    """A parser with what all trials take; `members` is the usual number of scenes."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--members", type=int, default=members, metavar="N", help=f"scenes, {members} if absent")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the scenes")
    parser.add_argument("--vpd", default="target/release/vpd", metavar="PATH", help="the program")
    parser.add_argument("--failing", metavar="FOLDER", help="where scenes go that break a promise, with the right end")
    return parser


class Program:
    """vpd, one run at a time."""

    def __init__(self, path, failing=None):
        self.path = Path(path).resolve()
        self.folder = tempfile.TemporaryDirectory()
        self.failing = Path(failing) if failing else None

    def command(self, *words):
        return ["nice", "-n", "5", str(self.path), *words]

    def run(self, scenario, limit_s=900):
        """(the summary of the run, "") or (None, the first line of what went wrong). `limit_s` is of processor time, which other
        programs on the machine do not use up."""
        log = Path(self.folder.name) / "run.mcap"
        command = self.command("run", "-", "--json", "--force", "-o", str(log))

        def limited():
            resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))

        done = subprocess.run(command, input=json.dumps(scenario), capture_output=True, text=True, preexec_fn=limited)
        if done.returncode < 0:
            return None, f"ended by signal {-done.returncode}; {limit_s} s of processor time are allowed"
        if done.returncode == 0:
            return json.loads(done.stdout), ""
        if done.stdout:
            # A run that failed on its way.
            return None, f"exit {done.returncode}: {json.loads(done.stdout)['diagnosis']}"
        return None, f"exit {done.returncode}: {(done.stderr.strip() or 'no word').splitlines()[0]}"

    def keep(self, scenario, **found):
        """Writes a scene that breaks a promise, and next to it what was found and what is right."""
        if self.failing:
            self.failing.mkdir(parents=True, exist_ok=True)
            (self.failing / f"{scenario['name']}.json").write_text(json.dumps(scenario, indent=1) + "\n")
            (self.failing / f"{scenario['name']}.found").write_text(json.dumps(found, indent=1, default=plain) + "\n")


def plain(value):
    return value.tolist()


def pieces(table):
    """A table as polynomials: [(start_s, end_s, c)], its value c[0] + c[1] s + c[2] s^2 + c[3] s^3 at the time s after the start."""
    times, values = np.array(table["times_s"], float), np.array(table["values"], float)
    kind = table.get("interpolation", "monotone")
    # Two equal times are a jump; nothing reaches over it.
    ends = [0, *(np.flatnonzero(np.diff(times) == 0) + 1), len(times)]
    found = []
    for first, last in zip(ends, ends[1:]):
        t, v = times[first:last], values[first:last]
        # A jump at the first time of a table, or the last.
        if len(t) == 1:
            continue
        if kind == "monotone":
            cubics = PchipInterpolator(t, v).c[::-1].T
        elif kind == "linear":
            cubics = [(a, (b - a) / h, 0.0, 0.0) for a, b, h in zip(v, v[1:], np.diff(t))]
        else:
            cubics = [(a, 0.0, 0.0, 0.0) for a in v[:-1]]
        found += [(float(a), float(b), tuple(map(float, c))) for a, b, c in zip(t, t[1:], cubics)]
    return found


def stretches(tables, duration_s):
    """The run cut at all knots of all tables: [(start_s, end_s, [c of each table from there on])]."""
    cut = [pieces(table) for table in tables]
    knots = {0.0, float(duration_s)}
    knots |= {t for table in cut for piece in table for t in piece[:2] if 0 < t < duration_s}
    knots = sorted(knots)
    found = []
    for start, end in zip(knots, knots[1:]):
        cubics = []
        for table in cut:
            a, c = next((a, c) for a, b, c in table if a <= start and end <= b)
            s = start - a
            value, slope = c[0] + s * (c[1] + s * (c[2] + s * c[3])), c[1] + s * (2 * c[2] + s * 3 * c[3])
            cubics.append((value, slope, c[2] + s * 3 * c[3], c[3]))
        found.append((start, end, cubics))
    return found


def norm(momentum):
    """The length of a momentum: a vector, or a skew matrix, whose entries above the diagonal count. Also of tiny ones."""
    entries = np.asarray(momentum, float)
    entries = entries if entries.ndim == 1 else entries[np.triu_indices(len(entries), 1)]
    largest = np.abs(entries).max(initial=0.0)
    return largest * np.linalg.norm(entries / largest) if largest > 1e-300 else largest


def distance(end, other, largest):
    """The error of vpd: spectral norm of the difference of the attitudes, plus that of the momenta in parts of the largest."""
    (attitude, momentum), (other_attitude, other_momentum) = end, other
    turned = np.linalg.norm(np.asarray(attitude) - other_attitude, 2)
    gained = norm(np.asarray(momentum) - other_momentum)
    return turned + (gained / largest if largest > 0 else gained)


def end_of(summary):
    """Attitude and body momentum at the end of a run of vpd."""
    return np.array(summary["final"]["attitude"]), np.array(summary["final"]["body_momentum"])


def leave(counts, broken):
    """The last line, and the exit code."""
    print("; ".join(f"{count} {what}" for what, count in counts.items()) + ("; BROKEN" if broken else "; kept"))
    sys.exit(1 if broken else 0)

"""The shipped chain of three links in vpd and in the simulators that people use: error against time, in one run.

    python3 -m venv venv && venv/bin/pip install mujoco==4.0.0 drake==1.51.1 heyoka==7.13.2 numpy
    nice -n -5 venv/bin/python docs/chain.py target/release/vpd

It prints a table for each of two starts of scenarios/chain.json: let go at half its angles, until 50 s, and as it is shipped, until 10 s.
(From the shipped start an error of the last digit grows by 1e10 and more in 50 s: nobody's doubles know where the chain is then.)

The known end is that of heyoka's Taylor series in 80-bit floats, of equations that share nothing with any of them: Newton's and Euler's
of each link, with the forces in the joints as unknowns. Other tolerances lead to the same end, and a start that is 1e-16 away says how
many digits doubles can have.

An error is the largest angle between the attitude of a link and the known one, at the end, in radians. Each program has the same masses,
the same moments and joint points, and doubles. MuJoCo: ball joints, contacts and constraints off, no damping, no armature; its loop
over all steps is in C. Drake: ball joints by roll, pitch and yaw, the only ones it has, in a continuous plant without geometry, its
integrators of third and fifth order with steps that they choose for an accuracy, and the latter with constant ones. Times are of the integration alone, without start,
logs and samples: each program in a process of its own, one after the other, again and again; the least of all rounds counts. They are
those of the processor, which other work on the machine changes less than those of the clock; of vpd, that of the whole program less
that of a run of one step. A run of many steps is timed by its first ones.
"""

import json
import math
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import heyoka as hy
import numpy as np

from simulators import DRAKE, MUJOCO, angle, drake, mujoco

SCENARIO = json.loads((Path(__file__).parent.parent / "scenarios/chain.json").read_text())
STARTS = {"let go at half its angles, t = 50 s": (0.5, 50.0), "as it is shipped, t = 10 s": (1.0, 10.0)}
GOAL = 1e-10
# Steps of a second that the table shows, and the most that are tried for the goal; an accuracy that steps are chosen for.
SHOWN, MOST, FINEST = [50, 200, 800], 8000, 1e-14
ROUNDS, TIMED, LIMIT_S = 5, 2000, 10.0


@dataclass
class Chain:
    """Links of a mass and moments, and where each hangs and the next one does, from its centre of mass. The first hangs at a point of space."""

    masses: list
    moments: list
    own: list
    next: list
    hung_at: list
    gravity: float

    @staticmethod
    def shipped():
        scene = SCENARIO["scene"]
        points = [[np.array(point, float) for point in joint["points"]] for joint in scene["joints"]]
        return Chain(
            [body["mass"] for body in scene["bodies"]],
            [np.array(body["inertia"]["principal"]) for body in scene["bodies"]],
            [own for _, own in points],
            [above for above, _ in points[1:]],
            points[0][0],
            9.81,
        )


CHAIN = Chain.shipped()
NAMES = [body["name"] for body in SCENARIO["scene"]["bodies"]]


# ---- the known end


def product(p, q):
    """Of quaternions w, x, y, z."""
    p, q = np.asarray(p), np.asarray(q)
    return np.array([p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))])


def rotation(q):
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def start(scale, real=float):
    """[(quaternion, angular velocity in the body)], each attitude turned by a part of the angle of the scenario."""
    links = []
    for body in SCENARIO["scene"]["bodies"]:
        turn = body["initial"]["attitude"]["axis_angle"]
        axis = np.array(turn["axis"], real)
        half = real(scale) * real(turn["angle_deg"]) / 360 * (np.arctan(real(1)) * 4)
        q = np.array([np.cos(half), *(np.sin(half) * axis / np.sqrt(axis @ axis))])
        links.append((q, np.array(body["initial"]["angular_velocity"]["body"], real)))
    return links


def elements(skewed):
    """The matrix of a cross product."""
    x, y, z = skewed
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def equations(chain, links):
    """The derivatives of [(q, omega)]: F_a is the force on link a where it hangs, and its opposite acts on the link above."""
    count = len(links)
    turns = [rotation(q) for q, _ in links]
    free = [-np.cross(w, J * w) / J for (_, w), J in zip(links, chain.moments)]

    def of_force(a, p, s):
        """The acceleration of the point p of link a by a force at its point s."""
        inner = elements(p) @ (elements(s) / chain.moments[a][:, None])
        return np.eye(3) / chain.masses[a] - turns[a] @ inner @ turns[a].T

    def without(a, p):
        """The acceleration of the point p without forces in the joints."""
        w = links[a][1]
        return turns[a] @ (np.cross(free[a], p) + np.cross(w, np.cross(w, p))) - np.array([0, 0, chain.gravity])

    # The point where link a hangs and the one it hangs from have the same acceleration.
    matrix, right = np.zeros((3 * count, 3 * count), object), np.zeros(3 * count, object)
    at = [slice(3 * a, 3 * a + 3) for a in range(count)]
    for a, own in enumerate(chain.own):
        matrix[at[a], at[a]] += of_force(a, own, own)
        right[at[a]] -= without(a, own)
    for a, next in enumerate(chain.next):
        below = a + 1
        matrix[at[a], at[below]] -= of_force(a, chain.own[a], next)
        matrix[at[below], at[a]] -= of_force(a, next, chain.own[a])
        matrix[at[below], at[below]] += of_force(a, next, next)
        right[at[below]] += without(a, next)
    # Elimination; the matrix is symmetric and positive, so nothing is exchanged. Blocks further off the diagonal are zero.
    for c in range(3 * count):
        for i in range(c + 1, min(3 * count, 3 * (c // 3) + 6)):
            part = matrix[i, c] / matrix[c, c]
            matrix[i, c:] -= part * matrix[c, c:]
            right[i] -= part * right[c]
    for c in reversed(range(3 * count)):
        right[c] = (right[c] - matrix[c, c + 1 :] @ right[c + 1 :]) / matrix[c, c]
    torques = [np.cross(own, turns[a].T @ right[at[a]]) for a, own in enumerate(chain.own)]
    for a, next in enumerate(chain.next):
        torques[a] -= np.cross(next, turns[a].T @ right[at[a + 1]])
    return [(product(q, [0, *w]) / 2, free[a] + torques[a] / chain.moments[a]) for a, (q, w) in enumerate(links)]


def system(chain):
    """The same for heyoka: [(variable, derivative)], seven of a link."""
    count = len(chain.masses)
    variables = np.array([hy.make_vars(f"x{i}") for i in range(7 * count)])
    links = [(variables[7 * a : 7 * a + 4], variables[7 * a + 4 : 7 * a + 7]) for a in range(count)]
    rates = np.concatenate([np.concatenate(rate) for rate in equations(chain, links)])
    return list(zip(variables, rates))


class Known:
    def __init__(self):
        self.system = system(CHAIN)

    def end(self, scale, seconds, moved=0.0, tolerance=None):
        real = np.longdouble
        state = np.concatenate([np.concatenate(link) for link in start(scale, real)])
        state[1] += real(moved)
        options = {} if tolerance is None else {"tol": real(tolerance)}
        series = hy.taylor_adaptive(self.system, state, fp_type=real, compact_mode=True, **options)
        series.propagate_until(real(seconds))
        return [series.state[7 * a : 7 * a + 4].astype(float) for a in range(3)]


def distance(ends, known):
    return max(angle(list(q), list(goal)) for q, goal in zip(ends, known))


# ---- what a program's end says of its energy and its joints


def energy(links):
    """Above the lowest position, of attitudes and angular velocities in the bodies."""
    total, joint, joint_velocity, lowest = 0.0, CHAIN.hung_at, np.zeros(3), CHAIN.hung_at[2]
    for a, (q, w) in enumerate(links):
        turn = rotation(q)
        centre = joint - turn @ CHAIN.own[a]
        velocity = joint_velocity - turn @ np.cross(w, CHAIN.own[a])
        lowest -= np.linalg.norm(CHAIN.own[a])
        total += 0.5 * (CHAIN.masses[a] * velocity @ velocity + w @ (CHAIN.moments[a] * w))
        total += CHAIN.masses[a] * CHAIN.gravity * (centre[2] - lowest)
        if a < 2:
            joint, joint_velocity = centre + turn @ CHAIN.next[a], velocity + turn @ np.cross(w, CHAIN.next[a])
            lowest -= np.linalg.norm(CHAIN.next[a])
    return total


def gap(links, centres):
    """The largest distance of two points that a joint holds together."""
    point, largest = CHAIN.hung_at, 0.0
    for a, ((q, _), centre) in enumerate(zip(links, centres)):
        largest = max(largest, np.linalg.norm(centre + rotation(q) @ CHAIN.own[a] - point))
        if a < 2:
            point = centre + rotation(q) @ CHAIN.next[a]
    return largest


# ---- the programs: each gives ([(q, omega)], [centre], seconds of the integration), or nothing where it fails


def with_vpd(program, method, scale, seconds, steps):
    scenario = json.loads(json.dumps(SCENARIO))
    for body, (q, w) in zip(scenario["scene"]["bodies"], start(scale)):
        body["initial"] = {"attitude": {"quaternion": list(q)}, "angular_velocity": {"body": list(w)}}
    for key in ("duration_s", "expect", "description"):
        scenario.pop(key)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "chain.mcap"

        def run(count):
            """(has it succeeded?, seconds of the processor)."""
            short = {"method": method, "step_s": seconds / steps, "steps": count, "log": {"every": count, "channels": ["/bodies/*/state"]}}
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            words = [program, "run", "-", "--json", "--force", "-o", log]
            done = subprocess.run(words, input=json.dumps(scenario | short), capture_output=True, text=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            return done.returncode == 0, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime

        # What a run takes that takes one step is not of the integration.
        besides = min(run(1)[1] for _ in range(3))
        succeeded, spent = run(steps)
        if not succeeded:
            return None
        table = subprocess.run([program, "export", log], capture_output=True, text=True, check=True).stdout.splitlines()
    row = dict(zip(table[0].split(","), table[-1].split(",")))
    of = lambda name, what, axes: np.array([float(row[f"{name}_{what}_{axis}"]) for axis in axes])
    links = [(of(name, "quaternion", "wxyz"), of(name, "angular_velocity", "xyz")) for name in NAMES]
    return links, [of(name, "position", "xyz") for name in NAMES], spent - besides


def mujoco_chain(integrator, step):
    body = ""
    for a in reversed(range(3)):
        # The frame of a body is where it hangs.
        place = CHAIN.hung_at if a == 0 else CHAIN.next[a - 1] - CHAIN.own[a - 1]
        words = lambda numbers: " ".join(repr(float(x)) for x in numbers)
        body = (f'<body pos="{words(place)}"><joint type="ball"/><inertial pos="{words(-CHAIN.own[a])}" mass="{CHAIN.masses[a]}" '
                f'diaginertia="{words(CHAIN.moments[a])}"/>{body}</body>')
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="{step!r}" gravity="0 0 {-CHAIN.gravity}" integrator="{integrator}"><flag contact="disable" constraint="disable"/></option>
  <worldbody>{body}</worldbody>
</mujoco>""")


def with_mujoco(integrator, scale, seconds, steps):
    model = mujoco_chain(integrator, seconds / steps)
    data = mujoco.MjData(model)
    # A ball joint has the attitude and the angular velocity of its link as seen from the link above.
    above = (np.array([1.0, 0, 0, 0]), np.zeros(3))
    for a, (q, w) in enumerate(start(scale)):
        back = above[0] * [1, -1, -1, -1]
        data.qpos[4 * a : 4 * a + 4] = product(back, q)
        data.qvel[3 * a : 3 * a + 3] = w - rotation(q).T @ rotation(above[0]) @ above[1]
        above = q, w
    begun = time.process_time()
    mujoco.mj_step(model, data, nstep=steps)
    spent = time.process_time() - begun
    if any(warning.number for warning in data.warning):
        return None
    # Places and velocities of links belong to the state before the last step.
    mujoco.mj_forward(model, data)
    links, above = [], (np.array([1.0, 0, 0, 0]), np.zeros(3))
    for a in range(3):
        q = product(above[0], data.qpos[4 * a : 4 * a + 4])
        w = data.qvel[3 * a : 3 * a + 3] + rotation(q).T @ rotation(above[0]) @ above[1]
        links.append((q, w))
        above = q, w
    return links, [data.xipos[1 + a].copy() for a in range(3)], spent


def with_drake(integrator, chooses, scale, seconds, fine):
    """It `chooses` its steps for an accuracy, or takes as many as are given."""
    plant = drake.MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -CHAIN.gravity])
    above, links, joints = plant.world_frame(), [], []
    for a, name in enumerate(NAMES):
        unit = drake.UnitInertia(*(CHAIN.moments[a] / CHAIN.masses[a]))
        link = plant.AddRigidBody(name, drake.SpatialInertia(CHAIN.masses[a], [0, 0, 0], unit))
        place = CHAIN.hung_at if a == 0 else CHAIN.next[a - 1]
        parent = plant.AddFrame(drake.FixedOffsetFrame(f"above {name}", above, drake.RigidTransform(place)))
        child = plant.AddFrame(drake.FixedOffsetFrame(f"of {name}", link.body_frame(), drake.RigidTransform(CHAIN.own[a])))
        joints.append(plant.AddJoint(drake.BallRpyJoint(name, parent, child, damping=0.0)))
        above = link.body_frame()
        links.append(link)
    plant.Finalize()
    simulator = drake.Simulator(plant)
    context = simulator.get_mutable_context()
    seen = (np.eye(3), np.zeros(3))
    for joint, (q, w) in zip(joints, start(scale)):
        turn = rotation(q)
        relative = drake.RotationMatrix(drake.Quaternion(q / np.linalg.norm(q))).matrix()
        relative = seen[0].T @ relative
        joint.set_angles(context, drake.RollPitchYaw(drake.RotationMatrix.ProjectToRotationMatrix(relative)).vector())
        joint.set_angular_velocity(context, seen[0].T @ (turn @ w - seen[1]))
        seen = turn, turn @ w
    drake.ResetIntegratorFromFlags(simulator, integrator, 0.1 if chooses else seconds / fine)
    if chooses:
        simulator.get_mutable_integrator().set_target_accuracy(fine)
    else:
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
    simulator.Initialize()
    begun = time.process_time()
    try:
        simulator.AdvanceTo(seconds)
    except (RuntimeError, ValueError):
        return None
    spent = time.process_time() - begun
    ends, centres = [], []
    for link in links:
        pose = plant.EvalBodyPoseInWorld(context, link)
        turned = pose.rotation()
        ends.append((turned.ToQuaternion().wxyz(), turned.matrix().T @ plant.EvalBodySpatialVelocityInWorld(context, link).rotational()))
        centres.append(pose.translation())
    return ends, centres, spent


# ---- the table


def alone(run, *words):
    """A run in a process of its own."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.apply(run, words)


class Row:
    """A program and a method. How fine it is is a number of steps, or, of steps that it chooses, an accuracy."""

    def __init__(self, label, run, words, accuracies=None):
        self.label, self.run, self.words, self.accuracies = label, run, words, accuracies

    def measure(self, known, scale, seconds):
        self.known, self.scale, self.seconds = known, scale, seconds
        # By how fine it is: (error, energy error, gap), or nothing where it fails; and the least time.
        self.found, self.least_s = {}, {}
        self.shown = self.accuracies or [round(seconds * rate) for rate in SHOWN]
        for fine in self.shown:
            self.at(fine)
        self.goal = self.coarsest()

    def at(self, fine):
        end = alone(self.run, *self.words, self.scale, self.seconds, fine)
        self.found[fine] = end and (
            distance([q for q, _ in end[0]], self.known),
            abs(energy(end[0]) / energy(start(self.scale)) - 1),
            gap(*end[:2]),
        )
        self.least_s[fine] = end and end[2]
        return self.found[fine]

    def coarsest(self):
        """The coarsest of what is tried that reaches the goal, by factors of the root of two, or of ten for accuracies."""
        factor, last = (0.1**0.5, FINEST) if self.accuracies else (2**0.5, MOST * self.seconds)
        reached = [fine for fine in self.shown if self.found[fine] and self.found[fine][0] <= GOAL]
        if reached:
            # From before the coarsest that is known to do.
            fine = reached[0] / factor**4
        else:
            # From before where a power law through the last two leads, if that is not too far.
            one, two = self.shown[-2:]
            if not self.found[one] or not self.found[two] or self.found[one][0] <= 1.5 * self.found[two][0]:
                return None
            order = math.log(self.found[one][0] / self.found[two][0]) / math.log(two / one)
            times = math.log(self.least_s[two] / self.least_s[one]) / math.log(two / one)
            further = (self.found[two][0] / GOAL) ** (1 / order)
            fine = two * further
            if (fine - last) * (factor - 1) > 0 or self.least_s[two] * further**times > LIMIT_S:
                return None
            fine /= factor**2
        while True:
            fine *= factor
            fine = fine if self.accuracies else round(fine)
            if (fine - last) * (factor - 1) > 0:
                return None
            found = self.at(fine)
            if found and found[0] <= GOAL:
                return fine
            if self.least_s[fine] and self.least_s[fine] > 2 * LIMIT_S:
                return None

    def time(self, fine):
        """One round of timing: of the first steps, or of a whole run, as long as that is short."""
        if self.least_s[fine] is None or self.accuracies and self.least_s[fine] > LIMIT_S / ROUNDS:
            return
        steps = fine if self.accuracies else min(fine, TIMED)
        seconds = self.seconds if self.accuracies else self.seconds * steps / fine
        end = alone(self.run, *self.words, self.scale, seconds, steps)
        if end:
            self.least_s[fine] = min(self.least_s[fine], end[2] * (1.0 if self.accuracies else fine / steps))

    def cells(self):
        size = lambda fine: f"accuracy {fine:.0e}" if self.accuracies else f"{fine:,} steps"
        for fine in self.shown:
            if not self.found[fine]:
                yield "fails"
            else:
                note = f" ({fine:.0e})" if self.accuracies else ""
                yield f"{self.found[fine][0]:.1e} in {milliseconds(self.least_s[fine])} ms{note}"
        if self.goal is None:
            yield from ("not reached", "", "", "")
        else:
            _, of_energy, apart = self.found[self.goal]
            yield from (size(self.goal), milliseconds(self.least_s[self.goal]), f"{of_energy:.0e}", f"{apart:.0e}")


def milliseconds(seconds):
    """Three digits, without an exponent."""
    return f"{float(f'{1e3 * seconds:.3g}'):,.10g}"


def rows(program):
    found = []
    if mujoco:
        found += [Row(f"MuJoCo {MUJOCO} {kind}", with_mujoco, (kind,)) for kind in ("Euler", "implicit", "RK4")]
    if drake:
        found.append(Row(f"Drake {DRAKE} runge_kutta3", with_drake, ("runge_kutta3", True), [1e-3, 1e-4, 1e-5]))
        found.append(Row(f"Drake {DRAKE} runge_kutta5", with_drake, ("runge_kutta5", True), [1e-5, 1e-8, 1e-11]))
        found.append(Row(f"Drake {DRAKE} runge_kutta5, constant steps", with_drake, ("runge_kutta5", False)))
    methods = [("vpd", f"gauss{stages}") for stages in (1, 2, 3, 4, 6, 8)] + [("rk_projected", "rk4"), ("rk_projected", "rk8")]
    for name, tableau in methods:
        found.append(Row(f"vpd, `{name}` {tableau}", with_vpd, (program, {"name": name, "tableau": tableau})))
    return found


def main():
    program = str(Path(sys.argv[1]).resolve())
    # MuJoCo writes its warnings where it stands.
    os.chdir(tempfile.mkdtemp())
    exact = Known()
    for name, (scale, seconds) in STARTS.items():
        known = exact.end(scale, seconds)
        other, moved = exact.end(scale, seconds, tolerance=1e-17), exact.end(scale, seconds, moved=1e-16)
        print(f"{name}: known to {distance(other, known):.0e} rad; a start 1e-16 away ends {distance(moved, known):.0e} rad away\n")
        table = rows(program)
        for row in table:
            row.measure(known, scale, seconds)
            print(*row.cells(), file=sys.stderr, flush=True)
        for _ in range(ROUNDS):
            for row in table:
                for fine in {*row.shown, row.goal} - {None}:
                    row.time(fine)
        head = ["", *(f"{round(rate * seconds):,} steps" for rate in SHOWN), f"{GOAL:.0e} takes", "ms", "energy error", "gap in joints, m"]
        print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
        for row in table:
            print("| " + " | ".join([row.label, *row.cells()]) + " |")
        print(f"\nload {', '.join(f'{x:.1f}' for x in os.getloadavg())}\n", flush=True)


if __name__ == "__main__":
    main()

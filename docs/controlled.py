"""Controlled bodies in vpd and in Basilisk: the same laws, sampled at the same times and held in between, error against time.

    python3 -m venv venv && venv/bin/pip install bsk==2.12.1 scipy==1.17.1 numpy==2.4.6
    venv/bin/python docs/controlled.py target/release/vpd

It prints a table for each of two scenes.

Three wheels: the scenario of docs/scenario.md#control-by-samples (a satellite is turned by 120 degrees by three reaction wheels that
are sampled ten times a second), for 60 s. Basilisk: `Spacecraft` with `ReactionWheelStateEffector`, balanced wheels without friction and
with no limits of their own.

B-dot: scenarios/detumble.json (a CubeSat in the field of a dipole along a circular orbit, sampled once a second), for 3,000 s, in which
its rate falls to a tenth. Basilisk: `Spacecraft` with `MtbEffector`, three coils along the axes of the body. That has the field in
space from a message, once a step, and turns it into the body at each stage; the message is of the start of the step, as Basilisk's own
modules of fields would give it, or of its middle. And `MJScene`, whose models can run at each stage: one in Python computes field and
torque there. (It has `highOrderAttitudeIntegration`, without which its attitude is of order two.)

Alike: moments, starts, the laws with their limits and their gains, times of samples, ideal sensors, commands held from their sample to
the next, field and orbit as functions of time alone, doubles. Laws and field are one text in Python here, of the known solution and, as
a `SysModel`, of Basilisk; vpd has its own. In Basilisk the controller runs at its sample, after the step that ends there, and its
command acts from then on.

The known solution is that of scipy's DOP853 to 1e-13, from sample to sample, of Euler's equations and a quaternion; one to 3e-14 says how
well it is known. An error is the angle between an attitude and the known one, in radians: at the end, and the largest at the ends of
the tenths of a run. The drift is the largest change there, with the longest steps, of the angular momentum in space of body and wheels
together, in parts of what it is at the start.

A time is that of the clock, of the integration alone: of vpd what it reports of its integrator, with a sample of the log at both ends; of
Basilisk its loop over all steps, and in brackets the same without the laws and the field, for these take longer in Python than they
would in a module in C. Each run is timed by its first tenth, ten times that, the least of five rounds in turn.
"""

import csv
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import MtbEffector, magneticFieldCenteredDipole, mujoco, reactionWheelStateEffector, spacecraft, svIntegrators
from Basilisk.utilities import SimulationBaseClass
from scipy.integrate import DOP853

from simulators import BASILISK, angle

HERE = Path(__file__).parent
ROUNDS, PARTS = 5, 10


def product(a, b):
    """Of quaternions."""
    return np.array([
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ])


def cross(a, b):
    """numpy's own takes ten times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def to_body(q, v):
    """A vector of space in the body, whatever the length of the quaternion."""
    turn = cross(v, q[1:])
    return v + 2 * (q[0] * turn + cross(turn, q[1:])) / (q @ q)


def to_space(q, v):
    return to_body(q * [1, -1, -1, -1], v)


def of_rodrigues(s):
    """The quaternion of modified Rodrigues parameters."""
    s = np.array(s)
    square = s @ s
    return np.array([1 - square, *(2 * s)]) / (1 + square)


# ---- the scenes: what acts, and the laws


class Wheels:
    """A scene of reaction wheels. Its command is the torques of the motors."""

    has_wheels = True

    def __init__(self, scenario):
        scene = scenario["scene"]
        control = scene["control"]
        wheels, law, target = control["through"]["wheels"], control["laws"][0]["attitude"], control["target"]["attitude"]["axis_angle"]
        self.scenario, self.seconds, self.every = scenario, scenario["duration_s"], control["every_s"]
        self.inertia = np.array(scene["inertia"]["principal"])
        self.omega = np.array(scene["initial"]["angular_velocity"]["body"])
        self.speeds = np.zeros(3)
        self.axes, self.moments = np.array(wheels["axes"], float), np.array(wheels["moments_kg_m2"])
        self.limit, self.most = wheels["limit_n_m"], wheels["limit_n_m_s"]
        self.gain, self.rate_gain = law["gain_n_m"], law["rate_gain_n_m_s"]
        half, axis = math.radians(target["angle_deg"]) / 2, np.array(target["axis"])
        self.back = np.array([math.cos(half), *(-math.sin(half) * axis / np.linalg.norm(axis))])
        # The body with wheels that nobody turns; the axes are those of the body here.
        self.inverse = np.linalg.inv(np.diag(self.inertia) - self.axes.T @ np.diag(self.moments) @ self.axes)

    def law(self, t, q, w, speeds, memory):
        """The command of a sample, `speeds` of the wheels relative to the body."""
        error = product(self.back, q)
        torque = -self.gain * math.copysign(2, error[0]) * error[1:] - self.rate_gain * w
        command = np.clip(-(self.axes @ torque), -self.limit, self.limit)
        relative = self.moments * speeds
        low, high = (-self.most - relative) / self.every, (self.most - relative) / self.every
        return np.clip(command, np.minimum(low, 0), np.maximum(high, 0))

    def rates(self, t, state, command):
        q, w, speeds = state[:4], state[4:7], state[7:]
        momentum = self.inertia * w + self.axes.T @ (self.moments * speeds)
        turning = self.inverse @ (cross(momentum, w) - self.axes.T @ command)
        return np.concatenate([product(q, [0, *w]) / 2, turning, command / self.moments - self.axes @ turning])

    def momentum(self, q, w, speeds):
        """In space, of body and wheels."""
        return to_space(q, self.inertia * w + self.axes.T @ (self.moments * speeds))


class Coils:
    """A scene of magnetorquers. Its command is the magnetic moment."""

    has_wheels = False

    def __init__(self, scenario):
        scene = scenario["scene"]
        control, self.dipole = scene["control"], scene["field"]["dipole"]
        self.scenario, self.seconds, self.every = scenario, scenario["duration_s"], control["every_s"]
        self.inertia = np.array(scene["inertia"]["principal"])
        self.omega = np.array(scene["initial"]["angular_velocity"]["body"])
        self.gain = control["laws"][0]["b_dot"]["gain_a_m2_s_per_t"]
        self.limit = control["through"]["magnetorquers"]["limit_a_m2"]
        self.speeds = np.zeros(0)

    def place(self, t):
        """The direction of the place on the orbit."""
        along, inclined = self.dipole["orbit"]["mean_motion_rad_s"] * t, self.dipole["orbit"]["inclination_rad"]
        return np.array([math.cos(along), math.sin(along) * math.cos(inclined), math.sin(along) * math.sin(inclined)])

    def field(self, t):
        """In space: moment / r^3 (3 (d . x) x - d)."""
        d, place = self.dipole, self.place(t)
        turned, tilt = d["rotation_rad_s"] * t, d["tilt_rad"]
        axis = -np.array([math.sin(tilt) * math.cos(turned), math.sin(tilt) * math.sin(turned), math.cos(tilt)])
        return d["moment_t_m3"] / d["orbit"]["semi_major_axis_m"] ** 3 * (3 * (axis @ place) * place - axis)

    def law(self, t, q, w, speeds, memory):
        field = to_body(q, self.field(t))
        change = field - memory.get("field", field)
        memory["field"] = field
        return np.clip(-self.gain * change / self.every, -self.limit, self.limit)

    def rates(self, t, state, command):
        q, w = state[:4], state[4:7]
        torque = cross(command, to_body(q, self.field(t)))
        return np.concatenate([product(q, [0, *w]) / 2, (cross(self.inertia * w, w) + torque) / self.inertia])


def known(scene, tolerance):
    """The states at the end of each part: (quaternion, angular velocity, wheel speeds)."""
    samples = round(scene.seconds / scene.every)
    state = np.array([1.0, 0, 0, 0, *scene.omega, *scene.speeds])
    memory, found = {}, []
    for k in range(samples):
        t = k * scene.every
        command = scene.law(t, state[:4], state[4:7], state[7:], memory)
        solver = DOP853(lambda t, y: scene.rates(t, y, command), t, state, (k + 1) * scene.every, rtol=tolerance, atol=1e-3 * tolerance)
        while solver.status == "running":
            solver.step()
        state = solver.y
        state[:4] /= np.linalg.norm(state[:4])
        if (k + 1) % (samples // PARTS) == 0:
            found.append((state[:4].copy(), state[4:7].copy(), state[7:].copy()))
    return found


# ---- vpd


def with_vpd(scene, steps, timed, program, method):
    """The states at the end of each part; or, of the first part alone, the time of the whole."""
    parts, every = (1, steps // PARTS) if timed else (PARTS, steps // PARTS)
    lasting = {"step_s": scene.seconds / steps, "duration_s": scene.seconds * parts / PARTS, "log": {"every": every}}
    with tempfile.TemporaryDirectory() as folder:
        log, table = Path(folder) / "controlled.mcap", Path(folder) / "controlled.csv"
        words = [program, "run", "-", "--json", "-o", log]
        scenario = json.dumps(scene.scenario | {"method": method} | lasting)
        done = subprocess.run(words, input=scenario, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stderr or done.stdout)
        summary = json.loads(done.stdout)
        if timed:
            return summary["ns_per_step"] * 1e-9 * summary["steps"] * PARTS
        subprocess.run([program, "export", log, "-o", table], capture_output=True, check=True)
        rows = list(csv.DictReader(table.open()))[1:]
    of = lambda row, name, axes: np.array([float(row[f"{name}_{axis}"]) for axis in axes])
    speeds = lambda row: of(row, "wheel_speeds", "123") if scene.has_wheels else np.zeros(0)
    return [(of(row, "quaternion", "wxyz"), of(row, "angular_velocity", "xyz"), speeds(row)) for row in rows]


# ---- Basilisk


class Controller(sysModel.SysModel):
    """The law of a scene, at each sample: of what `read` gives, to `write`."""

    def __init__(self, scene, read, write):
        super().__init__()
        self.scene, self.read, self.write, self.memory = scene, read, write, {}

    def UpdateState(self, nanoseconds):
        self.write(self.scene.law(nanoseconds * 1e-9, *self.read(), self.memory), nanoseconds)


class Field(sysModel.SysModel):
    """The field for the step that begins, as it is `ahead` of the time."""

    def __init__(self, scene, ahead):
        super().__init__()
        self.scene, self.ahead = scene, ahead
        self.message = messaging.MagneticFieldMsg().write(messaging.MagneticFieldMsgPayload())

    def UpdateState(self, nanoseconds):
        payload = messaging.MagneticFieldMsgPayload()
        payload.magField_N = list(self.scene.field(nanoseconds * 1e-9 + self.ahead))
        self.message.write(payload, nanoseconds, self.moduleID)


class TorqueOfCoils(sysModel.SysModel):
    """For `MJScene`: the torque of the moment that acts, at each stage."""

    def __init__(self, scene, state):
        super().__init__()
        self.scene, self.state, self.acting = scene, state, np.zeros(3)
        self.message = messaging.TorqueAtSiteMsg().write(messaging.TorqueAtSiteMsgPayload())

    def UpdateState(self, nanoseconds):
        q = of_rodrigues(self.state.read().sigma_BN)
        payload = messaging.TorqueAtSiteMsgPayload()
        payload.torque_S = list(cross(self.acting, to_body(q, self.scene.field(nanoseconds * 1e-9))))
        self.message.write(payload, nanoseconds, self.moduleID)


def with_basilisk(scene, steps, timed, integrator, how=None, controlled=True):
    """As `with_vpd`. `how` is when the field is taken; not `controlled`, nothing runs in Python, and no command acts."""
    step_ns, every_ns = round(1e9 * scene.seconds / steps), round(1e9 * scene.every)
    simulation = SimulationBaseClass.SimBaseClass()
    process = simulation.CreateNewProcess("process")
    process.addTask(simulation.CreateNewTask("dynamics", step_ns), 2)
    process.addTask(simulation.CreateNewTask("control", every_ns), 1)
    # Basilisk has what it is given by address.
    keep = []
    if how == "stages":
        body, torque, state_message = basilisk_scene(scene)
        keep.append(torque)
        if controlled:
            body.AddModelToDynamicsTask(torque, 1)
        write = lambda command, nanoseconds: setattr(torque, "acting", command)
    else:
        body = spacecraft.Spacecraft()
        body.hub.mHub = 60.0
        body.hub.r_BcB_B = [[0.0]] * 3
        body.hub.IHubPntBc_B = np.diag(scene.inertia).tolist()
        body.hub.sigma_BNInit = [[0.0]] * 3
        body.hub.omega_BN_BInit = [[w] for w in scene.omega]
        state_message = body.scStateOutMsg
    body.setIntegrator(method := getattr(svIntegrators, f"svIntegrator{integrator}")(body))
    keep.append(method)
    speeds_message = None
    if scene.has_wheels:
        effector = reactionWheelStateEffector.ReactionWheelStateEffector()
        for axis, moment in zip(scene.axes, scene.moments):
            effector.addReactionWheel(wheel(axis, moment))
        body.addStateEffector(effector)
        commands = messaging.ArrayMotorTorqueMsg().write(messaging.ArrayMotorTorqueMsgPayload())
        effector.rwMotorCmdInMsg.subscribeTo(commands)
        speeds_message = effector.rwSpeedOutMsg
        # Takes the command before the spacecraft makes its step.
        simulation.AddModelToTask("dynamics", effector, 3)
        keep += [effector, commands]

        def write(command, nanoseconds):
            payload = messaging.ArrayMotorTorqueMsgPayload()
            payload.motorTorque = list(command)
            commands.write(payload, nanoseconds)
    elif how != "stages":
        effector = MtbEffector.MtbEffector()
        setting = messaging.MTBArrayConfigMsgPayload()
        setting.numMTB, setting.GtMatrix_B, setting.maxMtbDipoles = 3, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], [scene.limit] * 3
        settings = messaging.MTBArrayConfigMsg().write(setting)
        commands = messaging.MTBCmdMsg().write(messaging.MTBCmdMsgPayload())
        field = Field(scene, {"start": 0.0, "middle": 0.5e-9 * step_ns}[how])
        effector.mtbParamsInMsg.subscribeTo(settings)
        effector.mtbCmdInMsg.subscribeTo(commands)
        effector.magInMsg.subscribeTo(field.message)
        body.addDynamicEffector(effector)
        # Before the next step, after this one.
        if controlled:
            simulation.AddModelToTask("dynamics", field, 1)
        keep += [effector, settings, commands, field]

        def write(command, nanoseconds):
            payload = messaging.MTBCmdMsgPayload()
            payload.mtbDipoleCmds = list(command)
            commands.write(payload, nanoseconds)

    simulation.AddModelToTask("dynamics", body, 2)

    def read():
        state = state_message.read()
        speeds = np.array(speeds_message.read().wheelSpeeds[:3]) if speeds_message else np.zeros(0)
        return of_rodrigues(state.sigma_BN), np.array(state.omega_BN_B), speeds

    if controlled:
        controller = Controller(scene, read, write)
        simulation.AddModelToTask("control", controller)
    simulation.InitializeSimulation()
    if how == "stages":
        body.getBody("body").setAttitudeRate([[w] for w in scene.omega])
    simulation.ConfigureStopTime(0)
    simulation.ExecuteSimulation()
    states = []
    for part in range(1, PARTS + 1):
        begun = time.perf_counter()
        simulation.ConfigureStopTime(part * (steps // PARTS) * step_ns)
        simulation.ExecuteSimulation()
        if timed:
            return (time.perf_counter() - begun) * PARTS
        states.append(read())
    return states


def wheel(axis, moment):
    """An ideal one."""
    found = reactionWheelStateEffector.RWConfigPayload()
    found.gsHat_B = [[x] for x in axis]
    others = np.roll(axis, 1), np.roll(axis, 2)
    found.w2Hat0_B, found.w3Hat0_B = ([[x] for x in other] for other in others)
    found.Js, found.Omega, found.RWModel = moment, 0.0, messaging.BalancedWheels
    found.u_max = found.Omega_max = found.P_max = found.betaStatic = -1.0
    return found


def basilisk_scene(scene):
    """A free body, the torque on it, and its state."""
    moments = " ".join(repr(float(J)) for J in scene.inertia)
    body = mujoco.MJScene(f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="body"><freejoint/>
      <inertial pos="0 0 0" mass="4" diaginertia="{moments}"/><site name="coils" pos="0 0 0"/></body></worldbody></mujoco>""")
    body.extraEoMCall = body.highOrderAttitudeIntegration = True
    site = body.getBody("body").getSite("coils")
    torque = TorqueOfCoils(scene, site.stateOutMsg)
    body.addTorqueActuator("torque", site).torqueInMsg.subscribeTo(torque.message)
    return body, torque, site.stateOutMsg


def own_field(scene, t):
    """That of Basilisk's dipole, of a planet that turns as the scene says, at the place of that time."""
    d, radius = scene.dipole, 6.4e6
    dipole = magneticFieldCenteredDipole.MagneticFieldCenteredDipole()
    size, turned = -d["moment_t_m3"] / radius**3, d["rotation_rad_s"] * t
    dipole.planetRadius, dipole.h11 = radius, 0.0
    dipole.g10, dipole.g11 = size * math.cos(d["tilt_rad"]), size * math.sin(d["tilt_rad"])
    place, planet = messaging.SCStatesMsgPayload(), messaging.SpicePlanetStateMsgPayload()
    place.r_BN_N = list(scene.place(t) * d["orbit"]["semi_major_axis_m"])
    planet.J20002Pfix = [[math.cos(turned), math.sin(turned), 0.0], [-math.sin(turned), math.cos(turned), 0.0], [0.0, 0.0, 1.0]]
    places, planets = messaging.SCStatesMsg().write(place), messaging.SpicePlanetStateMsg().write(planet)
    dipole.planetPosInMsg.subscribeTo(planets)
    dipole.addSpacecraftToModel(places)
    simulation = SimulationBaseClass.SimBaseClass()
    simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", 1))
    simulation.AddModelToTask("task", dipole)
    simulation.InitializeSimulation()
    simulation.ConfigureStopTime(0)
    simulation.ExecuteSimulation()
    return np.array(dipole.envOutMsgs[0].read().magField_N)


# ---- the tables


class Row:
    """A program, and what it is given; `steps` if it is not given all of them."""

    def __init__(self, label, run, words, steps=None):
        self.label, self.run, self.words, self.steps = label, run, words, steps
        self.found, self.least, self.bare = {}, {}, {}

    def measure(self, scene, steps, ends):
        if self.steps and steps not in self.steps:
            return
        states = self.run(scene, steps, False, *self.words)
        errors = [angle(q, known) for (q, _, _), (known, _, _) in zip(states, ends, strict=True)]
        self.found[steps] = errors[-1], max(errors)
        if scene.has_wheels and not hasattr(self, "drift"):
            first = scene.inertia * scene.omega
            moved = max(np.linalg.norm(scene.momentum(*state) - first) for state in states)
            self.drift = moved / np.linalg.norm(first)
        self.least[steps] = self.bare[steps] = math.inf

    def time(self, scene, steps):
        if steps not in self.found:
            return
        self.least[steps] = min(self.least[steps], self.run(scene, steps, True, *self.words))
        if self.run is with_basilisk:
            self.bare[steps] = min(self.bare[steps], self.run(scene, steps, True, *self.words, controlled=False))

    def cells(self, scene, all_steps):
        for steps in all_steps:
            if steps not in self.found:
                yield "-"
                continue
            last, largest = self.found[steps]
            bare = f" ({three(1e3 * self.bare[steps])})" if self.run is with_basilisk else ""
            yield f"{last:.1e}, {largest:.1e} in {three(1e3 * self.least[steps])}{bare} ms"
        first = all_steps[0]
        bare = f" ({three(1e6 * self.bare[first] / first)})" if self.run is with_basilisk else ""
        yield f"{three(1e6 * self.least[first] / first)}{bare}"
        if scene.has_wheels:
            yield f"{self.drift:.0e}"


def three(x):
    """Three digits, without an exponent."""
    return f"{float(f'{x:.3g}'):,.10g}"


def table(scene, ends, rows, all_steps):
    for row in rows:
        for steps in all_steps:
            row.measure(scene, steps, ends)
            print(row.label, steps, row.found.get(steps), file=sys.stderr, flush=True)
    for _ in range(ROUNDS):
        for row in rows:
            for steps in all_steps:
                row.time(scene, steps)
    head = ["", *(f"{steps:,} steps of {three(scene.seconds / steps)} s" for steps in all_steps), "us a step"]
    head += ["drift"] if scene.has_wheels else []
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join([row.label, *row.cells(scene, all_steps)]) + " |")
    print(f"\nload {', '.join(f'{x:.1f}' for x in os.getloadavg())}\n", flush=True)


def solved(name, scene):
    ends, other = known(scene, 1e-13), known(scene, 3e-14)
    apart = max(angle(a[0], b[0]) for a, b in zip(ends, other))
    print(f"{name}: known to {apart:.0e} rad\n", flush=True)
    return ends


def main():
    program = str(Path(sys.argv[1]).resolve())
    ours = [
        Row(f"vpd, `{name}` {tableau}", with_vpd, (program, {"name": name, "tableau": tableau}))
        for name, tableau in (("vpd", "gauss2"), ("vpd", "gauss3"), ("vpd", "gauss4"), ("rk_projected", "rk4"))
    ]
    text = (HERE / "scenario.md").read_text().split("## Control by samples")[1].split("```json")[1].split("```")[0]
    scenario = json.loads(text)
    del scenario["until"]
    wheels = Wheels(scenario | {"duration_s": 60.0})
    theirs = [Row(f"Basilisk {BASILISK}, {kind}", with_basilisk, (kind,)) for kind in ("RK4", "RKF78")]
    # The last does not divide the time between samples.
    table(wheels, solved("three wheels", wheels), theirs + ours, [600, 1200, 2400, 1500])

    scenario = json.loads((HERE.parent / "scenarios/detumble.json").read_text())
    del scenario["expect"]
    coils = Coils(scenario | {"duration_s": 3000.0})
    theirs = [
        Row(f"Basilisk {BASILISK}, RK4, field of the start of a step", with_basilisk, ("RK4", "start")),
        Row(f"Basilisk {BASILISK}, RK4, field of its middle", with_basilisk, ("RK4", "middle")),
        Row(f"Basilisk {BASILISK}, `MJScene`, RK4, field at each stage", with_basilisk, ("RK4", "stages")),
        Row(f"Basilisk {BASILISK}, `MJScene`, RKF78, field at each stage", with_basilisk, ("RKF78", "stages"), [3000]),
    ]
    ours = [Row(row.label, row.run, row.words) for row in ours]
    fields = [(own_field(coils, t), coils.field(t)) for t in (0.0, 1000.0, 2000.0)]
    apart = max(np.linalg.norm(own - field) / np.linalg.norm(field) for own, field in fields)
    print(f"the field of Basilisk's own dipole is this one to {apart:.0e}\n")
    table(coils, solved("B-dot", coils), theirs + ours, [3000, 6000, 12000])


if __name__ == "__main__":
    main()

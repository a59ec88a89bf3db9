#!/usr/bin/env bash
# Basilisk: a controller that samples between two steps of the dynamics sees an old state, and its command acts too early.
#
# Version: bsk 2.12.1 (Python).
# Behaviour: tasks have times of their own, and the dynamics steps at those of its task alone. With steps of 0.1 s a task at 0.25 s
# reads the state of 0.2 s, and a torque that it gives then acts on the body from 0.2 s on, before it was given. Nothing warns of it.
# Where the step divides the time between samples, both are right.
# Seen: a body of 1 kg m^2 under 1 N m from t = 0.25 s on turns at 0.1 rad/s at t = 0.3 s with steps of 0.1 s, and at 0.05 rad/s, as
# it should, with steps of 0.05 s. The state that the task reads at 0.25 s is of 0.2 s, and of 0.25 s.
# Expected of a reader of the schedule: a step that ends at the sample, a command that acts from then on, or a warning.
#
# Fails if the two steps give the same rate, or the same time of the state.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet --disable-pip-version-check bsk==2.12.1
cat > "$place/sample.py" <<'PYTHON'
import sys
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import extForceTorque, spacecraft
from Basilisk.utilities import SimulationBaseClass

MILLISECOND = 1_000_000

class Switch(sysModel.SysModel):
    """From 0.25 s on it wants 1 N m about x."""

    def __init__(self, state):
        super().__init__()
        self.state, self.seen_s = state, None
        self.message = messaging.CmdTorqueBodyMsg()

    def UpdateState(self, nanoseconds):
        on = nanoseconds >= 250 * MILLISECOND
        if on and self.seen_s is None:
            # The body moves along x by 1 m/s, so its place is a clock.
            self.seen_s = self.state.read().r_BN_N[0]
        wanted = messaging.CmdTorqueBodyMsgPayload()
        wanted.torqueRequestBody = [1.0 if on else 0.0, 0.0, 0.0]
        self.message.write(wanted, nanoseconds, self.moduleID)

def run(step_ms):
    simulation = SimulationBaseClass.SimBaseClass()
    process = simulation.CreateNewProcess("process")
    process.addTask(simulation.CreateNewTask("dynamics", step_ms * MILLISECOND), 2)
    process.addTask(simulation.CreateNewTask("control", 250 * MILLISECOND), 1)
    body = spacecraft.Spacecraft()
    body.hub.mHub = 1.0
    body.hub.IHubPntBc_B = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]
    body.hub.v_CN_NInit = [[1.0], [0.0], [0.0]]
    switch = Switch(body.scStateOutMsg)
    torque = extForceTorque.ExtForceTorque()
    torque.cmdTorqueInMsg.subscribeTo(switch.message)
    body.addDynamicEffector(torque)
    simulation.AddModelToTask("dynamics", torque, 2)
    simulation.AddModelToTask("dynamics", body, 1)
    simulation.AddModelToTask("control", switch)
    simulation.InitializeSimulation()
    simulation.ConfigureStopTime(300 * MILLISECOND)
    simulation.ExecuteSimulation()
    return round(body.scStateOutMsg.read().omega_BN_B[0], 9), round(switch.seen_s, 9)

(long, long_seen_s), (short, short_seen_s) = run(100), run(50)
print(f"steps of 0.1 s: {long} rad/s at 0.3 s, the state seen at 0.25 s is of {long_seen_s} s")
print(f"steps of 0.05 s: {short} rad/s at 0.3 s, the state seen at 0.25 s is of {short_seen_s} s")
sys.exit(0 if long != short and long_seen_s != short_seen_s else 1)
PYTHON
"$place/venv/bin/python" "$place/sample.py"

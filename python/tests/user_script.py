"""A script as users write them, for the type checkers; a test runs it, too."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import vpdsim as vpd

SCENE: dict[str, Any] = {
    "name": "body",
    "scene": {
        "inertia": {"principal": [1.0, 2.0, 3.0]},
        "initial": {"angular_velocity": {"body": [0.1, 0.2, 0.3]}},
    },
    "step_s": 0.01,
    "steps": 100,
}


def damping(time: float, attitude: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    return -0.5 * velocity


class Hinge:
    def energy(self, g: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.5 * g[:, 2, 2] ** 2

    def gradient(self, g: NDArray[np.float64]) -> NDArray[np.float64]:
        gradient = np.zeros_like(g)
        gradient[:, 2, 2] = g[:, 2, 2]
        return gradient


def main() -> float:
    vpd.run(SCENE, potential=Hinge())
    run = vpd.run(SCENE, set={"/step_s": 0.02})
    largest: float = float(np.abs(run.energy.error).max())
    last: NDArray[np.float64] = run.attitude[-1]
    try:
        vpd.check(SCENE)
    except vpd.ScenarioError as error:
        print(error.pointer, error.given, error.allowed)
    except vpd.RunFailed as failed:
        print(failed.code, failed.step)
    with vpd.Simulation(SCENE, torque=damping) as sim:
        sim.advance(0.1)
        sim.torque = [0.0, 0.0, 0.1]
        sim.torque = -sim.angular_velocity
    print(vpd.plan(SCENE)["steps"], run.outcome["steps"], last.shape)
    return largest


def service(client: vpd.Client) -> list[str]:
    job = client.submit(SCENE)
    for name, event in job.events():
        print(name, event["state"])
    job.wait().log("x.mcap")
    return [found.id for found in client.jobs(state="failed")]


if __name__ == "__main__":
    print(main())

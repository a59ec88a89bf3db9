"""A run that is stepped from Python."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._scene import Scene, text_of

Controller = Callable[[float, NDArray[np.float64], NDArray[np.float64]], ArrayLike]


class Simulation(_native.Simulation):
    """A run that you step, with a torque that is held until you change it.

        with vpd.Simulation("satellite.json", log="slew.mcap") as sim:
            while sim.time < 100:
                sim.torque = -0.1 * sim.angular_velocity
                sim.advance(0.1)

    The log is written when the simulation is closed, also after an exception. It is that of a job whose scene holds the torques as
    tables over time, so `vpd.verify` repeats it, and `scenario` is that job.

    Args:
        scene: a path of a JSON file, JSON text, or a dict. Its duration is not read.
        log: the MCAP log to write; none if absent.
        set: values of fields by their JSON pointers.
        torque: a function of the time in s, the attitude and the angular velocity, as below, that returns the torque. It is called
            before each step. What it raises ends `advance`.
        force: whether an existing log is replaced.

    Attributes:
        time: seconds since the start.
        step_s: the step in seconds.
        steps: steps made.
        attitude: the matrix from body to space coordinates, of shape (n, n).
        angular_velocity: in body coordinates, in rad/s: 3 numbers, or the n (n - 1) / 2 above the diagonal of the skew matrix.
        body_momentum: in body coordinates, in kg m^2/s, in the same order.
        torque: the torque from outside that is held, in body coordinates, in N m, in the same order.
        wheel_torque: the torque that wheels are driven with; refused for a scene without driven wheels.

    Raises:
        ScenarioError: the scenario is refused.
        RunFailed: from `advance`, a step could not be made.
    """

    # A misspelt attribute is an error.
    __slots__ = ()

    def __new__(
        cls,
        scene: Scene,
        *,
        log: str | os.PathLike[str] | None = None,
        set: Mapping[str, Any] | None = None,
        torque: Controller | None = None,
        force: bool = False,
    ) -> Simulation:
        path = None if log is None else os.fspath(log)
        return super().__new__(cls, text_of(scene, set), path, force, torque)

    @property
    def scenario(self) -> dict[str, Any]:
        """The job that makes the same run: the scene with the torques so far as tables over time."""
        job: dict[str, Any] = json.loads(self.job())
        return job

    def __enter__(self) -> Simulation:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<vpdsim.Simulation: {self.steps} steps to t = {self.time:g} s>"

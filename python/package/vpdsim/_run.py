"""The samples of a run, as arrays."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _arrow, _native
from ._errors import Absent, Error
from ._progress import Progress, follower
from ._scene import Scene, text_of

if TYPE_CHECKING:
    import pandas

Numbers = NDArray[np.float64]


class Potential(Protocol):
    """A potential energy U(g) of an attitude g: the n x n matrix from body to space coordinates.

    Both functions are called with k attitudes at once, an array of shape (k, n, n): all stages of a step, for the gradient.

    ```python
    class Hinge:
        def energy(self, g):                    # (k,), in J
            return 0.5 * g[:, 2, 2] ** 2

        def gradient(self, g):                  # D_ij = dU/dg_ij in J, (k, n, n)
            gradient = np.zeros_like(g)
            gradient[:, 2, 2] = g[:, 2, 2]
            return gradient
    ```

    A gradient that is not that of the energy is refused at the start of the run.
    """

    def energy(self, g: Numbers, /) -> ArrayLike: ...

    def gradient(self, g: Numbers, /) -> ArrayLike: ...


CHARTS = {
    "energy": "energy_error",
    "orthogonality": "orthogonality_error",
    "momentum": "momentum_drift",
    "pace": "pace_least_sigma",
}


class Group:
    """Quantities of one channel; one that the run does not have raises `Absent` and is left out of `dir`."""

    _channel: str
    _names: Mapping[str, str]

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._arrays = arrays

    def __getattr__(self, name: str) -> NDArray[Any]:
        column = type(self)._names.get(name)
        if column is None:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        return found(self._arrays, column, self._channel)

    def __dir__(self) -> list[str]:
        return [name for name, column in self._names.items() if column in self._arrays]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self.__dir__())})"


def found(arrays: Mapping[str, NDArray[Any]], column: str, channel: str) -> NDArray[Any]:
    try:
        return arrays[column]
    except KeyError:
        of_bodies = [name for name in arrays if name.endswith(f"_{column}")]
        if of_bodies:
            named = ", ".join(f'run.columns["{name}"]' for name in of_bodies[:4])
            raise Absent(f"the run has one {column} of each body: {named}") from None
        raise Absent(
            f"the run has no {column}: {channel} is not among its channels (/log/channels), or the scene has none"
        ) from None


class Energy(Group):
    """Energy in J, each of shape (samples,).

    `error` is the total less that at the start, and less `work` where time or torques put work in.
    """

    _channel = "/energy"
    _names = {
        "kinetic": "energy_kinetic",
        "potential": "energy_potential",
        "total": "energy_total",
        "error": "energy_error",
        "work": "energy_work",
        "jacobi_error": "jacobi_error",
    }


class Momentum(Group):
    """Angular momentum in space coordinates, in kg m^2/s: `spatial` and `impulse` of shape (samples, n (n - 1) / 2), `drift` of
    the part that the scene conserves and `table_impulse_error` of shape (samples,)."""

    _channel = "/momentum"
    _names = {
        "spatial": "spatial_momentum",
        "drift": "momentum_drift",
        "impulse": "momentum_impulse",
        "table_impulse_error": "momentum_table_impulse_error",
    }


class Solver(Group):
    """How the step before each sample was solved, each of shape (samples,): `iterations` (0 at the start), `increment`, `rung`
    (the solver's name, "" at the start), `sigma_min`."""

    _channel = "/solver"
    _names = {
        "iterations": "solver_iterations",
        "increment": "solver_increment",
        "rung": "solver_rung",
        "sigma_min": "solver_sigma_min",
    }


class Pace(Group):
    """Steps that adapt, each of shape (samples,): `sigma`, `step_s`, `own_steps`, `least_sigma`, `time_error_s`."""

    _channel = "/pace"
    _names = {
        "sigma": "pace_sigma",
        "step_s": "pace_step_s",
        "own_steps": "pace_own_steps",
        "least_sigma": "pace_least_sigma",
        "time_error_s": "pace_time_error_s",
    }


class Run:
    """The samples of a run, in memory or from a log.

    Every array belongs to the caller. A number that a sample does not have is NaN. Vectors of so(n) are three numbers for n = 3,
    else the n (n - 1) / 2 entries above the diagonal of the skew matrix, row by row.

    Attributes:
        columns: all arrays, by the names of the columns of `vpd export`.
        outcome: how it ended, as the JSON of `vpd run --json`; of a log what its last record says, {} if it is unfinished.
        plan: what was modelled and why, as the JSON of `vpd plan --json`.
        scenario: what was run, with every default written out; None of a log that holds none.
        log: the path of the log; None if there is none.
        damage: what is wrong with the end of an unfinished log; None if nothing is.
    """

    columns: dict[str, NDArray[Any]]
    outcome: dict[str, Any]
    plan: dict[str, Any]
    scenario: dict[str, Any] | None
    log: str | None
    damage: str | None

    def __init__(
        self,
        arrays: Mapping[str, Any],
        outcome: dict[str, Any],
        plan: dict[str, Any],
        scenario: dict[str, Any] | None,
        log: str | None = None,
        damage: str | None = None,
        number: int = 0,
    ) -> None:
        self.columns = {name: spelled(values) for name, values in arrays.items()}
        self.outcome = outcome
        self.plan = plan
        self.scenario = scenario
        self.log = log
        self.damage = damage
        self._number = number
        # A log that nobody asked for, of an ensemble, is there as long as the run is.
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @property
    def final(self) -> dict[str, Any]:
        """The last state: `attitude`, the matrix row by row, and `body_momentum`."""
        state: dict[str, Any] = self.outcome.get("final", {})
        return state

    @property
    def time(self) -> Numbers:
        """Seconds since the start, of shape (samples,)."""
        return self.columns["time_s"]

    @property
    def log_time_ns(self) -> NDArray[np.uint64]:
        """Nanoseconds since 1970, of shape (samples,)."""
        return self.columns["log_time_ns"]

    @property
    def attitude(self) -> Numbers:
        """Matrices from body to space coordinates, of shape (samples, n, n)."""
        return found(self.columns, "attitude", "/state")

    @property
    def quaternion(self) -> Numbers:
        """The same as unit quaternions (w, x, y, z), of shape (samples, 4), without jumps of the sign; n = 3."""
        return found(self.columns, "quaternion", "/state")

    @property
    def angular_velocity(self) -> Numbers:
        """In body coordinates, in rad/s, of shape (samples, n (n - 1) / 2)."""
        return found(self.columns, "angular_velocity", "/state")

    @property
    def body_momentum(self) -> Numbers:
        """Angular momentum in body coordinates, in kg m^2/s, of shape (samples, n (n - 1) / 2)."""
        return found(self.columns, "body_momentum", "/state")

    @property
    def energy(self) -> Energy:
        """Energy: `kinetic`, `potential`, `total`, `error`, and `work` and `jacobi_error` where there are any."""
        return Energy(self.columns)

    @property
    def momentum(self) -> Momentum:
        """Spatial momentum: `spatial`, `drift`, `impulse`."""
        return Momentum(self.columns)

    @property
    def solver(self) -> Solver:
        """The solver: `iterations`, `increment`, `rung`, `sigma_min`."""
        return Solver(self.columns)

    @property
    def pace(self) -> Pace:
        """Steps that adapt."""
        return Pace(self.columns)

    @property
    def orthogonality_error(self) -> Numbers:
        """Spectral norm of g g^T - I, of shape (samples,)."""
        return found(self.columns, "orthogonality_error", "/orthogonality")

    @property
    def transition(self) -> Numbers:
        """State transition matrices: the change of the state by that of the start, of shape (samples, n (n - 1), n (n - 1)).

        A state changes by `dg = g hat(xi)` and `dmu = hat(nu)`: first xi, then nu.
        """
        return found(self.columns, "transition", "/derivatives")

    @property
    def sensitivity(self) -> Numbers:
        """The change of the state with each of `/derivatives/parameters`, of shape (samples, parameters, n (n - 1))."""
        flat = found(self.columns, "sensitivity", "/derivatives")
        n: int = self.plan["dimension"]
        return flat.reshape(len(flat), -1, n * (n - 1))

    @property
    def covariance(self) -> Numbers:
        """Covariances of the change of the state to first order, of shape (samples, n (n - 1), n (n - 1)), ordered like `transition`."""
        return found(self.columns, "covariance", "/derivatives")

    def __len__(self) -> int:
        return len(self.time)

    def member(self, number: int) -> Run:
        """The samples of another member of an ensemble, of those that the log has in full (/ensemble/in_full)."""
        if self.log is None:
            raise Error("the run has no log, and is no ensemble")
        member = read(self.log, member=number)
        member._folder = self._folder
        return member

    def to_pandas(self) -> pandas.DataFrame:
        """A data frame with one column for each number, named as those of `vpd export`."""
        import pandas

        return pandas.DataFrame(flat(self.columns))

    def to_npz(self, path: str | os.PathLike[str]) -> None:
        """Writes the arrays for `numpy.load`, as `vpd export` does to a file named .npz."""
        np.savez(path, **self.columns)  # type: ignore[arg-type]

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """The table for programs of Arrow, without a copy: vectors and matrices are lists of a fixed size."""
        return _arrow.stream(self.columns)

    def chart(self, which: str = "energy") -> Chart:
        """An error over time as SVG: "energy", "orthogonality", "momentum" or, of steps that adapt, "pace"."""
        if which not in CHARTS:
            raise Error(f"{which!r} is no chart; there are {', '.join(CHARTS)}")
        values = self.columns.get(CHARTS[which])
        if values is None:
            raise Absent(f"the run has no {CHARTS[which]} to draw")
        if which == "pace":
            values = 1 / values
        return Chart(_native.chart(which, self.log_time_ns.tolist(), values.tolist()))

    def _state(self) -> str:
        return str(self.outcome.get("outcome", "unfinished"))

    def __repr__(self) -> str:
        name = (self.scenario or {}).get("name", "a system of one's own")
        member = f", member {self._number}" if self._number else ""
        return f"<vpdsim.Run {name}{member}: {self._state()}, {len(self)} samples to t = {self.time[-1]:g} s>"

    def _repr_html_(self) -> str:
        rows = {
            "scenario": (self.scenario or {}).get("name", ""),
            "outcome": self._state(),
            "samples": f"{len(self)}, to t = {self.time[-1]:g} s",
            "method": self.plan.get("formulation", {}).get("method", ""),
            "step": f"{self.plan['step_s']:g} s" if "step_s" in self.plan else "",
            "log": self.log or "",
        }
        cells = "".join(
            f"<tr><th style='text-align:left'>{key}</th><td style='text-align:left'>{escaped(str(value))}</td></tr>"
            for key, value in rows.items() if value
        )
        drawn = str(self.chart("energy")) if "energy_error" in self.columns else ""
        return f"<table>{cells}</table>{drawn}"


class Chart(str):
    """A picture as SVG, which a notebook shows."""

    def _repr_svg_(self) -> str:
        return str(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it to a file."""
        with open(path, "w", encoding="utf-8") as file:
            file.write(self)


def escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def spelled(values: Any) -> NDArray[Any]:
    """Words from their numbers."""
    if isinstance(values, tuple):
        numbers, words = values
        return np.array(words, dtype=str)[numbers]
    array: NDArray[Any] = values
    return array


def flat(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """One column for each number."""
    table: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            table[name] = values
        else:
            rows = values.reshape(len(values), -1)
            labels = places(name, values.shape[1:])
            table.update({f"{name}_{label}": rows[:, at] for at, label in enumerate(labels)})
    return table


def places(name: str, shape: tuple[int, ...]) -> list[str]:
    """What the columns for the places in a vector or a matrix are called."""
    if len(shape) == 2:
        return [f"{i + 1}_{j + 1}" for i in range(shape[0]) for j in range(shape[1])]
    if name == "quaternion" or name.endswith("_quaternion"):
        return list("wxyz")
    of_space = name.endswith(("position", "_velocity", "linear_momentum")) and not name.endswith("angular_velocity")
    if of_space and shape[0] != 3:
        # Of several bodies, one of each axis of space.
        return [str(number + 1) for number in range(shape[0])]
    if name in ("control_command", "wheel_momenta", "wheel_speeds", "sensitivity"):
        # Of an actuator or a wheel each; of one parameter after another.
        return [str(number + 1) for number in range(shape[0])]
    if shape[0] == 3:
        return list("xyz")
    # n (n - 1) / 2 entries above the diagonal.
    n = int((1 + (1 + 8 * shape[0]) ** 0.5) / 2 + 0.5)
    return [f"{i + 1}_{j + 1}" for i in range(n) for j in range(i + 1, n)]


def run(
    scene: Scene,
    *,
    log: str | os.PathLike[str] | None = None,
    set: Mapping[str, Any] | None = None,
    potential: Potential | None = None,
    force: bool = False,
    progress: Progress = False,
) -> Run:
    """Runs a scenario and returns its samples.

    Other threads of Python go on meanwhile, and Ctrl-C stops it; the log of a run that was stopped is resumed by the same call.

    Args:
        scene: a path of a JSON file, JSON text, or a dict.
        log: the MCAP log to write; none if absent. Its bytes are those of `vpd run`.
        set: values of fields by their JSON pointers, as {"/step_s": 0.02}; None removes a field.
        potential: a potential energy of your own, in addition to the terms of the scene: an object with `energy(g)` and
            `gradient(g)`, see `Potential`. For one body that nothing else drives, by the method vpd. Its log is read by everything but
            `verify`, which does not know the law. What the functions raise ends the run, and is raised here.
        force: whether an existing log is replaced.
        progress: True for a bar, or a function of the steps done and of all.

    Raises:
        ScenarioError: the scenario is refused.
        RunFailed: a step could not be made; its `run` has the samples before.
        Error: the log cannot be written.
    """
    text = text_of(scene, set)
    folder = None
    if log is None and potential is None and b'"ensemble"' in text:
        folder = tempfile.TemporaryDirectory(prefix="vpdsim-")
        log = os.path.join(folder.name, "ensemble.mcap")
    path = None if log is None else os.fspath(log)
    follow = follower(progress, "steps")
    if potential is not None:
        outcome, plan, scenario, arrays = _native.run_with_potential(text, potential, path, force, follow)
    else:
        outcome, plan, scenario, arrays = _native.run(text, path, force, follow)
    made = Run(arrays, json.loads(outcome), json.loads(plan), json.loads(scenario), path)
    made._folder = folder
    _native.raise_if_failed(outcome, made)
    return made


def read(log: str | os.PathLike[str], *, member: int = 0) -> Run:
    """Reads the samples of a log, finished or not; of an ensemble, those of a member.

    Raises:
        Error: it is no log, or holds no samples.
    """
    path = os.fspath(log)
    inspection, arrays, damage = _native.read(path, member)
    seen = json.loads(inspection)
    job = {key: parsed(value) for key, value in (seen["job"] or {}).items()}
    outcome = {key: parsed(value) for key, value in (seen["outcome"] or {}).items()}
    if "state" in outcome:
        outcome["outcome"] = outcome.pop("state")
    return Run(arrays, outcome, job.get("plan", {}), job.get("scenario"), path, damage, member)


def parsed(text: str) -> Any:
    """An entry of a record: JSON, or a word."""
    try:
        return json.loads(text)
    except ValueError:
        return text

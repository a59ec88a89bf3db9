"""Rotating bodies on SO(n), integrated by symplectic methods: satellites, tops, pendulums, and their relatives in n dimensions.

    import vpdsim as vpd

    run = vpd.run("dipole.json")
    run.time, run.attitude, run.energy.error

`run` runs a scenario in memory or to a log, `read` reads a log, `Simulation` is stepped by you, `Client` asks a service; `plan`,
`check`, `verify`, `diff`, `fit` and `sweep` are the commands of the same names. All errors are below `Error`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

from . import _native
from ._client import Client, Job
from ._errors import Absent, Error, RunFailed, ScenarioError, ServiceError
from ._progress import Progress, follower
from ._run import Chart, Energy, Momentum, Pace, Potential, Run, Solver, read, run
from ._scene import Scene, is_text, text_of
from ._simulation import Controller, Simulation

__version__: str = _native.__version__

__all__ = [
    "Absent", "Chart", "Client", "Controller", "Energy", "Error", "Job", "Momentum", "Pace", "Potential", "Progress", "Run",
    "RunFailed", "ScenarioError", "Scene", "ServiceError", "Simulation", "Solver", "check", "diff", "fit", "plan", "read", "run",
    "schema", "sweep", "verify",
]


def plan(scene: Scene, *, set: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What a scenario will model and why, as the JSON of `vpd plan --json`.

    For an accuracy this makes runs, which Ctrl-C stops.

    Raises:
        ScenarioError: the scenario is refused.
    """
    planned: dict[str, Any] = json.loads(_native.plan(text_of(scene, set)))
    return planned


def check(scene: Scene, *, set: Mapping[str, Any] | None = None) -> None:
    """Checks a scenario without a run.

    Raises:
        ScenarioError: the scenario is refused.
    """
    _native.check(text_of(scene, set))


def verify(log: str | os.PathLike[str]) -> dict[str, Any]:
    """Runs the job in a log again and compares every sample bit for bit, as `vpd verify --json`: `same` is True or False.

    Raises:
        Error: the log is not finished, or its job cannot be run here.
    """
    verified: dict[str, Any] = json.loads(_native.verify(os.fspath(log)))
    return verified


def diff(
    first: str | os.PathLike[str] | Run,
    second: str | os.PathLike[str] | Run,
    *,
    member: int = 0,
    tolerance: float | Mapping[str, float] | None = None,
    rows: int = 20,
) -> dict[str, Any]:
    """Compares the motions in two logs over time, as `vpd diff --json`, with `agree` True or False.

    Args:
        first: a log, or a run that has one.
        second: the other.
        member: the member of ensembles.
        tolerance: the largest difference that counts as none, in rad, kg m^2/s and J; or those of quantities by name, as
            {"angle": 1e-6}. Without any, each difference counts.
        rows: rows of the table over time, at most.

    Raises:
        Error: they cannot be compared.
    """
    if tolerance is None:
        tolerances = []
    elif isinstance(tolerance, Mapping):
        tolerances = [f"{quantity}={largest!r}" for quantity, largest in tolerance.items()]
    else:
        tolerances = [repr(float(tolerance))]
    logs = [_log_of(log) for log in (first, second)]
    compared, agree = _native.diff(logs[0], logs[1], member, tolerances, rows)
    found: dict[str, Any] = json.loads(compared)
    return found | {"agree": agree}


def fit(
    scene: Scene,
    to: str | os.PathLike[str] | Run,
    fields: Sequence[str] = (),
    *,
    start_attitude: bool = False,
    set: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Finds the numbers of a scenario that bring its run closest to attitudes that were seen, as `vpd fit --json`.

    The result has `fitted` (of each number its `field`, `before`, `value` and `standard_error`), their `covariance`, `before_rad` and
    `after_rad` (roots of the mean squares of the residuals), `residuals` (time in s, before and after in rad), `runs`, and
    `scenario`, the fitted one, as `run` takes it.

    Args:
        scene: the scenario to begin with, within about a radian of each attitude.
        to: the attitudes: a log, a run that has one, or a CSV table as of `vpd export`.
        fields: JSON pointers of the numbers to fit, as in `/derivatives/parameters`.
        start_attitude: fit the attitude at the start as well.
        set: changes of the scenario, by JSON pointer.

    Raises:
        ScenarioError: the scenario or a field is refused.
        Error: the attitudes cannot be used, do not determine the fields, or no minimum was found.
    """
    found, fitted = _native.fit(text_of(scene, set), _log_of(to), list(fields), start_attitude)
    result: dict[str, Any] = json.loads(found)
    return result | {"scenario": json.loads(fitted)}


def _log_of(log: str | os.PathLike[str] | Run) -> str:
    if not isinstance(log, Run):
        return os.fspath(log)
    if log.log is None:
        raise Error("the run has no log: give one to vpd.run, as log=\"a.mcap\"")
    return log.log


def sweep(
    sweep: Scene,
    *,
    out: str | os.PathLike[str],
    threads: int | None = None,
    force: bool = False,
    progress: Progress = False,
) -> dict[str, Any]:
    """Runs a sweep into a table, or goes on with one that was stopped; returns how many members succeeded, failed, were refused.

    Args:
        sweep: a path of a JSON file, JSON text, or a dict.
        out: the table, CSV: `pandas.read_csv` reads it.
        threads: the number of threads; by default one for each core.
        force: whether an existing file is replaced.
        progress: True for a bar, or a function of the members done and of all.

    Raises:
        ScenarioError: the sweep is refused.
        Error: the table cannot be written.
    """
    is_file = isinstance(sweep, (str, os.PathLike)) and not is_text(sweep)
    file = os.fspath(sweep) if is_file else None  # type: ignore[arg-type]
    text = text_of(sweep)
    table = os.fspath(out)
    made: dict[str, Any] = json.loads(
        _native.sweep(file, text, table, threads, force, follower(progress, "members")))
    return made


def schema(of: str = "scenario") -> dict[str, Any]:
    """The JSON Schema of a scenario, or of a "sweep"."""
    found: dict[str, Any] = json.loads(_native.schema(of))
    return found

"""The exceptions of the package."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ._run import Run


class Error(Exception):
    """What goes wrong in this package, all of it."""


class ScenarioError(Error, ValueError):
    """A scenario or a sweep is refused.

    Attributes:
        pointer: JSON pointer (RFC 6901) of the field at fault; "" for the whole.
        given: the value there; None if there is none.
        allowed: what is allowed, in words.
        message: what was given and what is allowed, as the command line says it.
    """

    pointer: str
    given: Any
    allowed: str
    message: str

    def __init__(self, pointer: str, message: str, given: str | None = None) -> None:
        super().__init__(f"{pointer or 'the scenario'}: {message}")
        self.pointer = pointer
        self.message = message
        self.given = None if given is None else json.loads(given)
        before, comma, after = message.partition(" given, ")
        self.allowed = after if comma else before

    def __reduce__(self) -> tuple[Any, ...]:
        given = None if self.given is None else json.dumps(self.given)
        return type(self), (self.pointer, self.message, given)


class RunFailed(Error):
    """A step could not be made.

    Attributes:
        code: the failure code, which never changes its meaning.
        step: the step that failed, counted from 1.
        cause: what happened, for a person.
        advice: what to do, for a person.
        diagnosis: all that is known, as in the JSON of the command line.
        run: the run up to there; None from a `Simulation`.
    """

    code: str
    step: int
    cause: str
    advice: str
    diagnosis: dict[str, Any]
    run: Run | None

    def __init__(self, diagnosis: str, run: Run | None, message: str) -> None:
        super().__init__(message)
        self.diagnosis = json.loads(diagnosis)
        self.code = self.diagnosis["code"]
        self.step = self.diagnosis["step"]
        self.cause = self.diagnosis["cause"]
        self.advice = self.diagnosis["advice"]
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (json.dumps(self.diagnosis), None, str(self))


class ServiceError(Error):
    """A service refuses a request, or does not answer.

    Attributes:
        status: the HTTP status; None if there was no answer.
        code: the code of the problem, which never changes its meaning; "" without one.
        detail: what is wrong, for a person.
        pointer: JSON pointer of the field at fault; "" if it is none.
        problem: the problem details (RFC 9457) as the service sent them.
    """

    status: int | None
    code: str
    detail: str
    pointer: str
    problem: dict[str, Any]

    def __init__(self, message: str, status: int | None = None, problem: str = "{}") -> None:
        super().__init__(message)
        sent = json.loads(problem)
        self.problem = sent if isinstance(sent, dict) else {}
        self.status = status
        self.code = self.problem.get("code", "")
        self.detail = self.problem.get("detail", message)
        self.pointer = self.problem.get("pointer", "")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.status, json.dumps(self.problem))


class Absent(Error, AttributeError):
    """A run has no such quantity: its channel was not logged, or the scene has none."""

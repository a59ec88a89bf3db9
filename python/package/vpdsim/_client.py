"""A client of a service, `vpd serve`."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from typing import Any

from . import _native
from ._errors import Error
from ._progress import Progress, follower
from ._scene import Scene, text_of


class Job:
    """A job of a service.

    Attributes:
        id: its number.
        info: what the service said of it last, as its JSON: state, progress, plan, summary, diagnosis.
    """

    id: str
    info: dict[str, Any]

    def __init__(self, client: Client, info: dict[str, Any]) -> None:
        self._client = client
        self.info = info
        self.id = info["id"]

    @property
    def state(self) -> str:
        """What the service said last: queued, running, succeeded, failed or cancelled."""
        return str(self.info["state"])

    @property
    def name(self) -> str:
        """The name of its scenario."""
        return str(self.info["name"])

    def refresh(self) -> Job:
        """Asks the service how it stands."""
        self.info = json.loads(self._client._native.job(self.id))
        return self

    def wait(self, *, progress: Progress = False) -> Job:
        """Waits until it has ended, also over restarts of the service."""
        self.info = json.loads(self._client._native.wait(self.id, follower(progress, "steps")))
        return self

    def cancel(self) -> Job:
        """Stops it; its log is finished."""
        self.info = json.loads(self._client._native.cancel(self.id))
        return self

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """What happens to it until it has ended: pairs of a name, "state" or "progress", and its data."""
        for name, data in self._client._native.events(self.id):
            yield name, json.loads(data)

    def log(self, path: str | os.PathLike[str], *, force: bool = False, progress: Progress = False) -> str:
        """Fetches its log, which is compared with the checksum of the service; returns the path.

        A connection that breaks goes on where it was.
        """
        to = os.fspath(path)
        if not force and os.path.lexists(to):
            raise Error(f"{to} already exists; force=True replaces it")
        self._client._native.fetch(self.id, to, follower(progress, "bytes"))
        return to

    def __repr__(self) -> str:
        return f"<vpdsim.Job {self.id} {self.name}: {self.state}>"


class Client:
    """A service that takes jobs.

    A service that does not answer, is restarted, or has no room is asked again, as it says (`Retry-After`), for `patience_s`
    seconds. A job is sent under a key, so that there is one however often it had to be sent.

    Args:
        url: its address, as "http://localhost:8080".
        token: a token, if it asks for one; by default the environment variable VPD_TOKEN.
        patience_s: seconds for which a request is repeated.
    """

    def __init__(self, url: str, *, token: str | None = None, patience_s: float = 60.0) -> None:
        token = os.environ.get("VPD_TOKEN") if token is None else token
        self._native = _native.Client(url, token, patience_s)
        self.url = url

    def submit(self, scene: Scene, *, set: Mapping[str, Any] | None = None, key: str | None = None) -> Job:
        """Sends a scenario; the job that the service made of it.

        Args:
            scene: a path of a JSON file, JSON text, or a dict.
            set: values of fields by their JSON pointers.
            key: a name of the request: sent twice under the same one, a scenario is one job.

        Raises:
            ServiceError: the service refuses it, or does not answer.
        """
        return Job(self, json.loads(self._native.submit(text_of(scene, set), key)))

    def job(self, id: str) -> Job:
        """A job by its number."""
        return Job(self, json.loads(self._native.job(id)))

    def jobs(self, *, state: str | None = None, name: str | None = None, limit: int = 100) -> list[Job]:
        """The newest jobs, of a state and with a text in their names where these are given."""
        return [Job(self, info) for info in json.loads(self._native.jobs(state, name, limit))]

    def __repr__(self) -> str:
        return f"<vpdsim.Client {self.url}>"

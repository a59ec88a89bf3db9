"""What a job may rely on, whichever engine runs it: one suite, for a service that runs jobs itself and for one with workers.

    python engine.py

Runs it for a service by itself; cluster.py runs the same tests with Temporal, a bucket and workers.

Each test takes a bench: an engine with a service, whose processes it may kill, stop and put back.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import urllib.error
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VPD = os.path.abspath(os.environ.get("VPD", ROOT / "target/release/vpd"))
# How long a worker may give no sign of life.
LEASE_S = 4
# Long, for machines under load: no test waits so long where all is well.
PATIENCE_S = 300
# Steps that take about a second on the machine where this was written.
SECOND = 800_000


def call(url, body=None, method=None, headers=None, raw=False):
    """One request: status and JSON, or bytes."""
    data = None if body is None else json.dumps(body).encode()
    headers = {"content-type": "application/json"} | (headers or {})
    request = urllib.request.Request(url, data=data, headers=headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            status, content = answer.status, answer.read()
    except urllib.error.HTTPError as error:
        status, content = error.code, error.read()
    return status, content if raw else json.loads(content or b"null")


def wait(what, condition, patience_s=PATIENCE_S):
    """Waits for a condition; what it found."""
    end = time.monotonic() + patience_s
    while True:
        with contextlib.suppress(OSError):
            if found := condition():
                return found
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.05)


def scenario(steps, every=10, name="dipole"):
    text = json.loads((ROOT / "scenarios/dipole.json").read_text())
    text.pop("expect", None)
    text |= {"name": name, "steps": steps, "log": {"every": every}}
    return text


def alone(text, folder):
    """SHA-256 of the log of a scenario that the command line runs."""
    path = Path(folder) / "alone.json"
    path.write_text(json.dumps(text))
    log = path.with_suffix(".mcap")
    subprocess.run([VPD, "run", path, "-o", log, "--force", "--json"], check=True, stdout=subprocess.DEVNULL)
    sha256 = hashlib.sha256(log.read_bytes()).hexdigest()
    log.unlink()
    return sha256


class Process:
    """A process of the test's own; its output goes to a file."""

    def __init__(self, name, command, folder, env=None, prefix=()):
        self.name, self.command, self.folder = name, [*prefix, *map(str, command)], Path(folder)
        self.env, self.child = os.environ | (env or {}), None
        self.start()

    def start(self):
        self.folder.mkdir(parents=True, exist_ok=True)
        with open(self.said_in, "a") as out:
            self.child = subprocess.Popen(self.command, cwd=self.folder, env=self.env, stdout=out, stderr=out,
                                          start_new_session=True)

    @property
    def said_in(self):
        return self.folder / f"{self.name}.log"

    def said(self):
        return re.sub(r"\x1b\[[\d;]*m", "", self.said_in.read_text(errors="replace"))

    def send(self, what):
        os.kill(self.child.pid, what)

    def kill(self):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, signal.SIGKILL)
        self.child.wait()

    def stop(self):
        """Asks it to stop; its exit code."""
        self.send(signal.SIGTERM)
        return self.child.wait(timeout=60)


class Bench:
    """An engine to be tested, with its service; the parts that differ are those of its kinds."""

    def __init__(self, folder):
        self.folder, self.started, self.address, self.service = Path(folder), [], None, None

    def run(self, name, command, env=None, prefix=()):
        process = Process(name, command, self.folder, env, prefix)
        self.started.append(process)
        return process

    def listen(self, name, command, env=None):
        """Starts a service, and asks it from now on."""
        self.service = self.run(name, [
            VPD, "serve", *command, "--listen", "127.0.0.1:0", "--data", self.folder / name,
            "--requests-per-s", 100_000], env)
        self.await_service(self.service)
        return self.service

    def again(self, service):
        """Begins a service anew that ended, with what it has on its disk."""
        before = service.said().count("listening on")
        service.start()
        self.await_service(service, before)

    def await_service(self, service, before=0):
        found = wait("the service", lambda: re.findall(r"listening on (\S+)", service.said())[before:])
        self.address = found[-1]

    def submit(self, scenario, key=None):
        status, job = call(f"{self.address}/jobs", scenario, headers={"idempotency-key": key} if key else {})
        assert status in (200, 202), (status, job)
        return job["id"]

    def job(self, id):
        status, job = call(f"{self.address}/jobs/{id}")
        assert status == 200, (status, job)
        return job

    def ended(self, id, patience_s=PATIENCE_S):
        def found():
            job = self.job(id)
            return job if job["state"] in ("succeeded", "failed", "cancelled") else None
        return wait(f"the end of {id}", found, patience_s)

    def log(self, id):
        status, log = call(f"{self.address}/jobs/{id}/log.mcap", raw=True)
        assert status == 200, (status, log[:300])
        return log

    def runs(self, id):
        wait("a run", lambda: self.job(id)["progress"]["steps_done"] > 0)

    def durable(self, id, beyond=0):
        """Waits until the log of a job is safe beyond a step."""
        return wait("a durable step", lambda: (step := self.job(id)["progress"]["durable_step"]) > beyond and step)

    def close(self):
        for process in reversed(self.started):
            process.kill()


class Local(Bench):
    """A service that runs jobs itself, two at once."""

    def __init__(self, folder):
        super().__init__(folder)
        self.listen("service", ["--workers", 2])

    def holder(self, _id):
        """The process that runs a job."""
        return self.service

    def replace(self, process):
        """Something in the place of a holder that ended."""
        self.again(process)

    def taken_over(self, _id, _sleeper):
        """No other process could take the jobs of a service that slept: it sleeps past any lease."""
        time.sleep(2 * LEASE_S)

    def logs(self, ids):
        """SHA-256 of every log there is."""
        found = sorted((self.folder / "service").rglob("*.mcap*"))
        assert len(found) == len(ids), found
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in found]


def submit(bench):
    """Submit, follow, result, download with ranges: the same bytes as alone. Keys, lists, what is refused."""
    text = scenario(300_000)
    wanted = alone(text, bench.folder)
    id = bench.submit(text, key="one")
    assert bench.submit(text, key="one") == id
    status, refused = call(f"{bench.address}/jobs", scenario(300_001), headers={"idempotency-key": "one"})
    assert (status, refused["code"]) == (422, "idempotency_key_reused"), refused
    status, live = call(f"{bench.address}/jobs/{id}/live.mcap", raw=True)
    assert status == 200 and hashlib.sha256(live).hexdigest() == wanted
    job = bench.ended(id)
    assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
    log = bench.log(id)
    assert hashlib.sha256(log).hexdigest() == wanted
    url = f"{bench.address}/jobs/{id}/log.mcap"
    for place, bytes_ in [("0-19", log[:20]), ("-30", log[-30:]), ("1000-70000", log[1000:70001])]:
        assert call(url, headers={"range": f"bytes={place}"}, raw=True) == (206, bytes_), place
    assert call(url, headers={"range": f"bytes={len(log)}-"}, raw=True)[0] == 416
    with urllib.request.urlopen(url) as answer:
        etag = answer.headers["etag"]
    assert call(url, headers={"if-none-match": etag}, raw=True)[0] == 304
    assert call(url, headers={"range": "bytes=0-1", "if-range": '"other"'}, raw=True) == (200, log)
    for path in ["charts/energy.svg", "attitudes.json", "samples?channel=energy_error", "sent.json"]:
        assert call(f"{bench.address}/jobs/{id}/{path}", raw=True)[0] == 200, path
    assert [job["id"] for job in call(f"{bench.address}/jobs?state=succeeded")[1]["jobs"]] == [id]
    assert 'vpd_jobs{state="succeeded"} 1' in call(f"{bench.address}/metrics", raw=True)[1].decode()
    assert call(f"{bench.address}/studies")[1] == {"studies": []}
    status, refused = call(f"{bench.address}/jobs", scenario(0))
    assert (status, refused["pointer"]) == (422, "/steps"), refused
    # A job that asks for an accuracy is settled before it runs.
    text = scenario(1000) | {"accuracy": {"error": 1e-6}}
    for field in ["method", "step_s", "steps"]:
        text.pop(field)
    job = bench.ended(bench.submit(text | {"duration_s": 1.0}))
    assert job["state"] == "succeeded" and job["plan"]["step_s"] > 0, job


def cancel(bench):
    """A running job ends with a finished log, a waiting one at once, and both can be forgotten."""
    endless = scenario(400 * SECOND, every=100_000)
    running = [bench.submit(endless) for _ in range(2)]
    for id in running:
        bench.runs(id)
    waiting = bench.submit(scenario(1000))
    assert bench.job(waiting)["state"] == "queued"
    status, job = call(f"{bench.address}/jobs/{waiting}/cancel", method="POST")
    assert (status, job["state"]) == (200, "cancelled"), job
    for id in running:
        assert call(f"{bench.address}/jobs/{id}", method="DELETE")[1]["code"] == "job_running"
        assert call(f"{bench.address}/jobs/{id}/cancel", method="POST")[0] == 202
        job = bench.ended(id)
        assert job["state"] == "cancelled" and len(bench.log(id)) == job["log"]["bytes"] > 0, job
        assert call(f"{bench.address}/jobs/{id}/cancel", method="POST")[1]["code"] == "job_ended"
    for id in [*running, waiting]:
        assert call(f"{bench.address}/jobs/{id}", method="DELETE")[0] == 204
        assert call(f"{bench.address}/jobs/{id}")[0] == 404


def restart(bench):
    """The process that runs a job is killed, and then the service is stopped: all that was accepted ends, with its bytes."""
    text, short = scenario(6 * SECOND, every=100), scenario(1000)
    wanted, wanted_short = alone(text, bench.folder), alone(short, bench.folder)
    id = bench.submit(text)
    bench.durable(id)
    holder = bench.holder(id)
    holder.kill()
    bench.replace(holder)
    others = [bench.submit(short) for _ in range(5)]
    bench.runs(id)
    assert bench.service.stop() == 0, bench.service.said()
    bench.again(bench.service)
    job = bench.ended(id)
    assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
    assert job["summary"]["resumed_step"] > 0, job
    assert [bench.ended(id)["log"]["sha256"] for id in others] == [wanted_short] * 5
    listed = call(f"{bench.address}/jobs?limit=500")[1]["jobs"]
    assert sorted(job["id"] for job in listed) == sorted([id, *others]), listed


def poison(bench):
    """A job whose runs end their process is abandoned, and the others go on."""
    id = bench.submit(scenario(400 * SECOND, every=100_000, name="poison"))
    bench.runs(id)
    # Alone, or others would be suspects as well.
    holder = bench.holder(id)
    holder.kill()
    deaths, over = 0, threading.Event()

    def execute():
        nonlocal deaths
        while not over.is_set():
            for pid in filter(str.isdigit, os.listdir("/proc")):
                with contextlib.suppress(OSError):
                    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                    if words[1:2] == [b"apart"] and str(bench.folder) in os.readlink(f"/proc/{pid}/cwd"):
                        os.kill(int(pid), signal.SIGKILL)
                        deaths += 1
            time.sleep(0.002)

    executor = threading.Thread(target=execute)
    executor.start()
    try:
        bench.replace(holder)
        others = [bench.submit(scenario(SECOND, name="other")) for _ in range(4)]
        job = bench.ended(id)
    finally:
        over.set()
        executor.join()
    assert (job["state"], job["diagnosis"]["code"]) == ("failed", "worker_crashed"), job
    for other in others:
        assert bench.ended(other)["state"] == "succeeded"
    assert deaths
    print(f"      abandoned after {deaths} processes of its own; {len(others)} others done")


def pause(bench):
    """The process that runs a job sleeps past its lease and wakes: one result, of the right bytes."""
    text = scenario(10 * SECOND, every=100)
    wanted = alone(text, bench.folder)
    id = bench.submit(text)
    bench.durable(id)
    sleeper = bench.holder(id)
    sleeper.send(signal.SIGSTOP)
    bench.taken_over(id, sleeper)
    sleeper.send(signal.SIGCONT)
    job = bench.ended(id)
    assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
    wait("the sleeper to give up", lambda: "job goes back" in sleeper.said() or "job ended" in sleeper.said())
    assert bench.ended(id)["finished"] == job["finished"]
    assert bench.logs([id]) == [wanted]


SUITE = [submit, cancel, restart, poison, pause]


@contextlib.contextmanager
def local():
    """A service that runs jobs itself."""
    with place(Local) as bench:
        yield bench


@contextlib.contextmanager
def place(make):
    """A bench in a folder of its own, which stays if the test fails."""
    folder, made = tempfile.mkdtemp(prefix="vpd-engine-"), None
    try:
        made = make(folder)
        yield made
        made.close()
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        if made:
            made.close()
        if os.path.exists(folder):
            print(f"      what they said is in {folder}")


def report(tests):
    """Runs tests by their names; exits with 1 if one fails."""
    bad = 0
    for name, test in tests.items():
        begun = time.monotonic()
        try:
            test()
            print(f"pass  {name}: {test.__doc__.splitlines()[0]} ({time.monotonic() - begun:.0f} s)", flush=True)
        except Exception as error:
            bad += 1
            where = "".join(traceback.format_tb(error.__traceback__)[1:])
            print(f"FAIL  {name}: {type(error).__name__}: {str(error)[:2000]}\n{where}", flush=True)
    sys.exit(1 if bad else 0)


def on(engine):
    """The suite for an engine, by names."""
    def bound(part):
        def test():
            with engine() as bench:
                part(bench)
        test.__doc__ = part.__doc__
        return test
    return {part.__name__: bound(part) for part in SUITE}


if __name__ == "__main__":
    report(on(local))

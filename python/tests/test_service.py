"""A client, against the real service: also one that is killed and comes back."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from conftest import SCENARIOS

import vpdsim as vpd

PROGRAM = [os.environ["VPD"]] if "VPD" in os.environ else [sys.executable, "-m", "vpdsim"]


class Service:
    """`vpd serve` on a port that stays the same when it comes back."""

    def __init__(self, folder, *arguments, env=None):
        self.folder, self.arguments, self.env = folder, arguments, os.environ | (env or {})
        self.port, self.process = 0, None
        self.start()

    def start(self):
        command = [*PROGRAM, "serve", "--listen", f"127.0.0.1:{self.port}", "--data", self.folder / "jobs", *self.arguments]
        self.process = subprocess.Popen(map(str, command), stderr=subprocess.PIPE, text=True, env=self.env)
        for line in self.process.stderr:
            if found := re.search(r"listening on (http://127\.0\.0\.1:(\d+))", line):
                self.url, self.port = found[1], int(found[2])
                break
        else:
            raise RuntimeError("the service ended")
        # Its further lines must not fill the pipe.
        threading.Thread(target=self.process.stderr.read, daemon=True).start()

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self):
        self.process.terminate()
        self.process.wait()


@pytest.fixture
def service(tmp_path):
    with contextlib.ExitStack() as stack:
        def begin(*arguments, env=None):
            service = Service(tmp_path, *arguments, env=env)
            stack.callback(service.stop)
            return service

        yield begin


def test_a_job(service, dipole, tmp_path):
    client = vpd.Client(service().url)
    job = client.submit(dipole, set={"/steps": 1000})
    seen = []
    assert job.wait(progress=lambda *count: seen.append(count)).state == "succeeded"
    assert seen[-1] == (1000, 1000)
    log = job.log(tmp_path / "job.mcap", progress=lambda *count: seen.append(count))
    assert seen[-1][0] == seen[-1][1] == os.path.getsize(log)
    vpd.run(dipole, log=tmp_path / "here.mcap", set={"/steps": 1000})
    assert (tmp_path / "here.mcap").read_bytes() == (tmp_path / "job.mcap").read_bytes()
    with pytest.raises(vpd.Error, match="already exists"):
        job.log(tmp_path / "job.mcap")
    assert [(name, data["state"]) for name, data in job.events()][-1] == ("state", "succeeded")
    assert client.job(job.id).name == "dipole" and "dipole" in repr(job)


def test_lists_and_keys(service, dipole):
    client = vpd.Client(service().url)
    first = client.submit(dipole, key="one").wait()
    assert client.submit(dipole, key="one").id == first.id
    others = [client.submit(dipole | {"name": f"other {k}"}).wait() for k in range(3)]
    assert [job.id for job in client.jobs()] == [job.id for job in [first, *others][::-1]]
    assert len(client.jobs(limit=2)) == 2 and len(client.jobs(name="other")) == 3
    assert client.jobs(state="failed") == []
    failed = client.submit(dipole, set={"/step_s": 5.0, "/steps": 1000}).wait()
    assert failed.state == "failed" and failed.info["diagnosis"]["code"]
    assert [job.id for job in client.jobs(state="failed")] == [failed.id]


def test_refusals(service, dipole, tmp_path):
    client = vpd.Client(service().url)
    with pytest.raises(vpd.ServiceError) as caught:
        client.submit(dipole, set={"/step_s": 0})
    error = caught.value
    assert (error.status, error.code, error.pointer) == (422, "invalid_input", "/step_s")
    with pytest.raises(vpd.ServiceError) as caught:
        client.job("00000000-0000-7000-8000-000000000000")
    assert caught.value.status == 404
    running = client.submit(dipole, set={"/steps": 100_000_000})
    with pytest.raises(vpd.ServiceError) as caught:
        running.log(tmp_path / "a.mcap")
    assert caught.value.status == 409 and not list(tmp_path.glob("*.mcap")) and not list(tmp_path.glob(".vpd-*"))
    assert running.cancel().wait().state == "cancelled"
    with pytest.raises(vpd.ServiceError, match="not the address"):
        vpd.Client("localhost:8080")
    with pytest.raises(vpd.ServiceError, match="does not answer"):
        vpd.Client("http://127.0.0.1:9", patience_s=0.2).jobs()


def test_a_token(service, dipole, monkeypatch):
    token = "a-token-of-thirty-two-characters-1"
    url = service(env={"VPD_TOKENS": f"submit {token}"}).url
    monkeypatch.delenv("VPD_TOKEN", raising=False)
    with pytest.raises(vpd.ServiceError) as caught:
        vpd.Client(url).jobs()
    assert caught.value.status == 401
    assert vpd.Client(url, token=token).submit(dipole).wait().state == "succeeded"
    monkeypatch.setenv("VPD_TOKEN", token)
    assert len(vpd.Client(url).jobs()) == 1


def test_killed_and_restarted_under_it(service, dipole, tmp_path):
    """Jobs are sent while the service dies and comes back: each is there once, and all end well."""
    server = service("--workers", "2")
    client = vpd.Client(server.url, patience_s=120)
    jobs, events = [], []
    ended = threading.Event()

    def kill_and_restart():
        while not ended.wait(0.4):
            server.kill()
            time.sleep(0.2)
            server.start()

    thread = threading.Thread(target=kill_and_restart)
    thread.start()
    try:
        for k in range(30):
            jobs.append(client.submit(dipole, set={"/name": f"job {k}", "/steps": 20_000}))
        follower = threading.Thread(target=lambda: events.extend(jobs[-1].events()))
        follower.start()
        for job in jobs[:5]:
            job.wait()
    finally:
        ended.set()
        thread.join()
    for job in jobs:
        assert job.wait().state == "succeeded", job.info
    follower.join()
    assert events[-1][1]["state"] == "succeeded"
    listed = client.jobs(limit=1000)
    assert sorted(job.name for job in listed) == sorted(f"job {k}" for k in range(30))
    log = jobs[7].log(tmp_path / "a.mcap")
    vpd.run(dipole, log=tmp_path / "b.mcap", set={"/name": "job 7", "/steps": 20_000})
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes() and vpd.verify(log)["same"]


def test_the_command_line_does_the_same(service, command, tmp_path):
    url = service().url
    scene = SCENARIOS / "heavy-top.json"
    job = json.loads(command("submit", scene, "--to", url, "--json", "-o", tmp_path / "a.mcap", "--set", "/expect=null").stdout)
    assert job["state"] == "succeeded"
    vpd.run(scene, log=tmp_path / "b.mcap", set={"/expect": None})
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    command("fetch", job["id"], "--to", url, "-o", tmp_path / "c.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "c.mcap").read_bytes()
    assert command("fetch", job["id"], "--to", url, "-o", tmp_path / "c.mcap", check=False).returncode == 2
    assert job["id"] in command("jobs", "--to", url).stdout
    assert [found["id"] for found in json.loads(command("jobs", "--to", url, "--json").stdout)] == [job["id"]]
    refused = command("submit", scene, "--to", url, "--set", "/step_s=0", check=False)
    assert refused.returncode == 2 and "/step_s" in refused.stderr
    failed = command("submit", SCENARIOS / "dipole.json", "--to", url, "--wait", "--set", "/step_s=5", check=False)
    assert failed.returncode == 1 and "failed" in failed.stdout
    assert command("jobs", "--to", "localhost", check=False).returncode == 2

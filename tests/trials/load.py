"""A service under mixed load for hours: memory and threads stay level, and idle connections give their memory back.

    python load.py [--minutes 240] [--rate 3] [--idle 8000] [--vpd PATH] [--seed S]

Needs nothing but Python. Load and service run at the lowest priority, on this machine alone.
"""

import argparse
import contextlib
import http.client
import json
import os
import random
import re
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[2]
# Jobs and studies that the service keeps; the oldest are forgotten, as its users would.
KEPT = 60
# Streams that are followed at once.
FOLLOWED = 8
# Threads for work on files, which come and go with the moment.
THREADS = 3
# What may come and go with the moment, MiB.
SLACK_MIB = 12.0


class Service:
    """A service of its own: its memory and threads, and requests to it."""

    def __init__(self, vpd, folder):
        self.said = open(folder / "service.log", "w+")
        self.child = subprocess.Popen(
            ["nice", "-n", "19", vpd, "serve", "--listen", "127.0.0.1:0", "--data", folder / "data", "--workers", "1",
             "--connections", "10000", "--connections-per-client", "10000"], stdout=self.said, stderr=self.said)
        end = time.monotonic() + 60
        while not (found := re.search(r"listening on http://127.0.0.1:(\d+)", Path(self.said.name).read_text())):
            assert self.child.poll() is None and time.monotonic() < end, "the service does not start"
            time.sleep(0.1)
        self.port = int(found[1])

    def state(self):
        """Memory in MiB, threads, open files."""
        status = Path(f"/proc/{self.child.pid}/status").read_text()
        number = {name: int(re.search(rf"{name}:\s+(\d+)", status)[1]) for name in ["VmRSS", "Threads"]}
        return number["VmRSS"] / 1024, number["Threads"], len(os.listdir(f"/proc/{self.child.pid}/fd"))

    def connect(self):
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)

    def ask(self, method, path, body=None, **headers):
        """One request on a connection of its own: status and content."""
        with contextlib.closing(self.connect()) as connection:
            return spoken(connection, method, path, body, **headers)

    def stop(self):
        self.child.terminate()
        code = self.child.wait(timeout=60)
        self.said.close()
        return code


def spoken(connection, method, path, body=None, **headers):
    text = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request(method, path, text, {"content-type": "application/json"} | headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def scene(steps, name):
    text = json.loads((ROOT / "scenarios/dipole.json").read_text())
    text.pop("expect", None)
    return text | {"name": name, "steps": steps, "log": {"every": 10}}


class Load:
    """Requests of all kinds, chosen by chance, with what each must be answered."""

    def __init__(self, service, seed):
        self.service, self.random = service, random.Random(seed)
        self.jobs, self.studies, self.followers = [], [], []
        self.counts, self.wrong, self.over = {}, [], threading.Event()
        self.kinds = [(self.submit, 6), (self.lists, 5), (self.job, 6), (self.download, 4), (self.ranges, 4), (self.drawn, 4),
                      (self.follow, 4), (self.grow, 2), (self.study, 1), (self.cancel, 2), (self.refused, 3), (self.leave, 2),
                      (self.kept_alive, 2)]

    def check(self, what, status, *allowed):
        self.counts[status] = self.counts.get(status, 0) + 1
        if status not in allowed:
            self.wrong.append(f"{what}: {status}")

    def turn(self):
        kind = self.random.choices(*zip(*self.kinds))[0]
        kind()
        while len(self.jobs) > KEPT:
            id = self.jobs.pop(0)
            # One that still runs stays, and comes up again.
            status, _ = self.service.ask("DELETE", f"/jobs/{id}")
            self.check("forget", status, 204, 404, 409)
            if status == 409:
                self.service.ask("POST", f"/jobs/{id}/cancel")
                self.jobs.append(id)
                break

    def any_job(self):
        return self.random.choice(self.jobs) if self.jobs else "0190b5a8-0000-7000-8000-000000000000"

    def submit(self):
        # Milliseconds of computing, and now and then a second.
        steps = self.random.choice([1000, 3000, 10_000, 30_000, 800_000])
        key = {"idempotency-key": str(self.random.random())} if self.random.random() < 0.3 else {}
        status, content = self.service.ask("POST", "/jobs", scene(steps, f"load {steps}"), **key)
        self.check("submit", status, 202)
        if status == 202:
            self.jobs.append(json.loads(content)["id"])

    def lists(self):
        path = self.random.choice(["/jobs", "/jobs?state=succeeded&limit=5", "/jobs?name=load", "/studies", "/metrics", "/"])
        self.check(path, self.service.ask("GET", path)[0], 200)

    def job(self):
        self.check("job", self.service.ask("GET", f"/jobs/{self.any_job()}")[0], 200, 404)

    def download(self):
        self.check("log", self.service.ask("GET", f"/jobs/{self.any_job()}/log.mcap")[0], 200, 404, 409)

    def ranges(self):
        first = self.random.randrange(200_000)
        place = self.random.choice([f"{first}-{first + 5000}", f"-{first + 1}", f"{first}-", "0-0,-1"])
        status, _ = self.service.ask("GET", f"/jobs/{self.any_job()}/log.mcap", range=f"bytes={place}")
        self.check("range", status, 200, 206, 404, 409, 416)

    def drawn(self):
        what = self.random.choice(["charts/energy.svg", "attitudes.json", "samples?channel=energy_error", "scenario.json", "sent.json"])
        self.check(what, self.service.ask("GET", f"/jobs/{self.any_job()}/{what}")[0], 200, 404, 409)

    def in_background(self, what):
        self.followers = [thread for thread in self.followers if thread.is_alive()]
        if len(self.followers) < FOLLOWED:
            thread = threading.Thread(target=what, daemon=True)
            thread.start()
            self.followers.append(thread)

    def stream(self, path, share):
        """Reads a stream to its end, or leaves it after some pieces."""
        with contextlib.suppress(OSError, http.client.HTTPException), contextlib.closing(self.service.connect()) as connection:
            connection.request("GET", path)
            answer = connection.getresponse()
            self.check(path.rsplit("/")[-1], answer.status, 200, 404, 409)
            pieces = 0
            while answer.read1(4096) and not self.over.is_set() and pieces < share:
                pieces += 1

    def follow(self):
        path, pieces = f"/jobs/{self.any_job()}/events", self.random.choice([1, 3, 10**6])
        self.in_background(lambda: self.stream(path, pieces))

    def grow(self):
        path, pieces = f"/jobs/{self.any_job()}/live.mcap", self.random.choice([2, 10**6])
        self.in_background(lambda: self.stream(path, pieces))

    def study(self):
        methods = [{"name": "rkmk", "tableau": "rk4"}, {"name": "vpd", "tableau": "gauss2"}]
        study = self.random.choice([
            {"kind": "precision", "scenario": scene(200, "load"), "methods": methods, "until_s": 0.5},
            {"kind": "stability", "scenario": scene(200, "load"), "methods": methods[:1]}])
        status, content = self.service.ask("POST", "/studies", study)
        self.check("study", status, 202, 429)
        if status == 202:
            self.studies.append(json.loads(content)["id"])
        if len(self.studies) > 5:
            gone = self.studies.pop(0)
            self.service.ask("POST", f"/studies/{gone}/cancel")
            self.check("forget study", self.service.ask("DELETE", f"/studies/{gone}")[0], 204, 404, 409)

    def cancel(self):
        status, content = self.service.ask("POST", "/jobs", scene(50_000_000, "load endless"))
        self.check("submit", status, 202)
        if status == 202:
            id = json.loads(content)["id"]
            self.jobs.append(id)
            time.sleep(self.random.random())
            self.check("cancel", self.service.ask("POST", f"/jobs/{id}/cancel")[0], 200, 202)

    def refused(self):
        method, path, body, wanted = self.random.choice([
            ("POST", "/jobs", scene(0, "bad"), 422), ("POST", "/jobs", scene(1000, "n" * 304), 422), ("POST", "/jobs", b"{", 400),
            ("GET", "/jobs?limit=0", None, 400), ("GET", "/nothing", None, 404), ("DELETE", "/jobs", None, 405)])
        self.check(path, self.service.ask(method, path, body)[0], wanted)

    def leave(self):
        """A client that leaves in the middle of its request, or of the answer."""
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.service.port)) as client:
            whole = f"GET /jobs/{self.any_job()}/log.mcap HTTP/1.1\r\nhost: localhost\r\n\r\n".encode()
            client.sendall(whole[:self.random.choice([5, len(whole)])])
            client.recv(1)

    def kept_alive(self):
        with contextlib.closing(self.service.connect()) as connection:
            for _ in range(5):
                self.check("list", spoken(connection, "GET", "/jobs?limit=3")[0], 200)


def loaded(service, minutes, rate, seed):
    """Load for some minutes; a row a minute. What is wrong with the answers and with the series."""
    load, begun, rows, asked = Load(service, seed), time.monotonic(), [], 0
    due = begun
    print("minute   MiB  threads  files  requests")
    while (since := time.monotonic() - begun) < 60 * minutes:
        if since >= 60 * len(rows):
            rows.append(service.state())
            mib, threads, files = rows[-1]
            print(f"{len(rows) - 1:6} {mib:5.1f} {threads:8} {files:6} {asked:9}", flush=True)
        try:
            load.turn()
        except (OSError, http.client.HTTPException) as error:
            load.wrong.append(f"{type(error).__name__}: {error}")
        asked += 1
        # A machine that falls behind does not hurry afterwards.
        due = max(due + 1 / rate, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
    load.over.set()
    print("answers: " + ", ".join(f"{status} {count}" for status, count in sorted(load.counts.items())))
    wrong = [f"{len(load.wrong)} wrong answers, as {load.wrong[:3]}"] if load.wrong else []
    # The first third fills what is kept.
    part = len(rows) // 3
    if part >= 5:
        for at, name, slack in [(0, "MiB", SLACK_MIB), (1, "threads", THREADS), (2, "files", FOLLOWED)]:
            middle, last = ([row[at] for row in rows[start:start + part]] for start in (part, 2 * part))
            grew = median(last) - median(middle)
            print(f"{name}: {median(middle):.0f} in the second third, {median(last):.0f} in the last")
            if grew > slack:
                wrong.append(f"{name} grew by {grew:.1f}")
    return wrong


def idle(service, count):
    """Opens idle connections three times, half of them after an answer; what is wrong with the memory after them."""
    wrong, afters = [], []
    for _ in range(20):
        service.ask("GET", "/jobs")
    before = service.state()[0]
    for _ in range(3):
        begun, opened, peak = time.monotonic(), [], 0.0
        for number in range(count):
            client = socket.create_connection(("127.0.0.1", service.port))
            if number % 2:
                client.sendall(b"GET /jobs?limit=1 HTTP/1.1\r\nhost: localhost\r\n\r\n")
                client.recv(4096)
            opened.append(client)
            if number % 500 == 0:
                peak = max(peak, service.state()[0])
        took_s = time.monotonic() - begun
        peak, files = max(peak, service.state()[0]), service.state()[2]
        for client in opened:
            client.close()
        time.sleep(15)
        after, threads, left = service.state()
        afters.append(after)
        print(f"{count} connections in {took_s:.1f} s: before {before:.1f} MiB, with {peak:.1f} MiB ({files} files open), "
              f"15 s after {after:.1f} MiB ({left} files, {threads} threads)", flush=True)
        if left > 100:
            wrong.append(f"{left} files stay open")
    if max(afters) - before > SLACK_MIB:
        wrong.append(f"idle connections keep memory: {max(afters):.1f} MiB of {before:.1f} before them")
    return wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=240, metavar="N", help="of mixed load, 240 if absent")
    parser.add_argument("--rate", type=float, default=3, metavar="R", help="requests a second, 3 if absent")
    parser.add_argument("--idle", type=int, default=8000, metavar="N", help="idle connections, 8000 if absent; 0 for none")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the requests")
    parser.add_argument("--vpd", default=ROOT / "target/release/vpd", type=Path, metavar="PATH", help="the program")
    given = parser.parse_args()
    os.nice(19)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, given.idle + 1000)), hard))
    wrong = []
    for part in [lambda service: idle(service, given.idle) if given.idle else [],
                 lambda service: loaded(service, given.minutes, given.rate, given.seed) if given.minutes else []]:
        with tempfile.TemporaryDirectory(prefix="vpd-load-") as folder:
            service = Service(given.vpd.resolve(), Path(folder))
            try:
                wrong += part(service)
            finally:
                code = service.stop()
            if code != 0:
                wrong.append(f"the service ended with {code}")
    print("; ".join(wrong) + "; BROKEN" if wrong else "kept")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()

"""The service on many machines: with a Temporal, an S3 server and workers of its own, all real and all on this machine.

    python cluster.py [--large] [NAME ...]

Runs the tests with these names, or all. Sizes are those of a coffee break; --large takes those of an evening.
"""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import boto3
import yaml
from engine import LEASE_S, PATIENCE_S, ROOT, SECOND, VPD, Bench, alone, call, local, on, place, report, scenario, wait

BIN = Path(sys.executable).parent
KEYS = {"AWS_ACCESS_KEY_ID": "vpdkey", "AWS_SECRET_ACCESS_KEY": "vpdsecret", "AWS_REGION": "us-east-1"}
LARGE = "--large" in sys.argv


def free_port(host="127.0.0.1"):
    with socket.socket() as one:
        one.bind((host, 0))
        return one.getsockname()[1]


class Cluster(Bench):
    """The servers, a service and workers."""

    def __init__(self, folder, host="127.0.0.1"):
        super().__init__(folder)
        self.host, self.workers = host, {}
        self.temporal_at, self.s3_at = f"{host}:{free_port(host)}", f"{host}:{free_port(host)}"
        self.env = KEYS | {"AWS_ENDPOINT": f"http://{self.s3_at}", "AWS_ALLOW_HTTP": "true", "RUST_LOG": "info"}
        self.temporal = self.run("temporal", [
            # On another address it would not find itself.
            BIN / "temporal", "server", "start-dev", "--ip", "127.0.0.1" if host == "127.0.0.1" else "0.0.0.0", "--port", self.temporal_at.rsplit(":")[-1],
            "--headless", "--db-filename", "temporal.db", "--log-level", "error"])
        s3 = {"identities": [{"name": "vpd", "actions": ["Admin", "Read", "Write", "List", "Tagging"], "credentials": [
            {"accessKey": KEYS["AWS_ACCESS_KEY_ID"], "secretKey": KEYS["AWS_SECRET_ACCESS_KEY"]}]}]}
        (self.folder / "s3.json").write_text(json.dumps(s3))
        (self.folder / "blobs").mkdir()
        ports = {name: free_port(host) for name in ["master", "volume", "filer"]}
        self.metrics = free_port(host)
        # Each has a second port for its own protocol, 10,000 above unless specified.
        grpc = {name: free_port(host) for name in [*ports, "s3"]}
        self.store = self.run("store", [
            BIN / "weed", "server", "-dir=blobs", f"-ip={host}", f"-ip.bind={host}", "-s3", "-s3.config=s3.json",
            f"-s3.port={self.s3_at.rsplit(':')[-1]}", "-s3.port.iceberg=0", "-s3.port.lance=0",
            "-volume.max=50", "-master.volumeSizeLimitMB=256",
            f"-metricsPort={self.metrics}", *(f"-{name}.port={port}" for name, port in ports.items()),
            *(f"-{name}.port.grpc={port}" for name, port in grpc.items())])
        self.s3 = boto3.client("s3", endpoint_url=f"http://{self.s3_at}", region_name="us-east-1",
                               aws_access_key_id="vpdkey", aws_secret_access_key="vpdsecret")
        wait("the store", self.made_bucket, 120)
        self.await_temporal()

    def made_bucket(self):
        try:
            self.s3.create_bucket(Bucket="vpd")
            self.s3.put_object(Bucket="vpd", Key="probe", Body=b"probe")
            return True
        except Exception:
            return False

    def await_temporal(self):
        check = [BIN / "temporal", "operator", "cluster", "health", "--address", self.temporal_at]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        wait("Temporal", lambda: subprocess.run(check, **quiet).returncode == 0, 120)

    def together(self):
        return ["--bucket", "s3://vpd/record", "--temporal", self.temporal_at]

    def serve(self, *args, name="service", env=None):
        return self.listen(name, ["--engine", "cluster", *self.together(), "--lease-s", LEASE_S, *args],
                           self.env | (env or {}))

    def work(self, number, *args, env=None, prefix=(), workers=1):
        worker = self.run(f"worker-{number}", [
            VPD, "worker", *self.together(), "--scratch", self.folder / f"scratch-{number}", "--workers", workers,
            *args], self.env | (env or {}), prefix)
        self.workers[number] = worker
        return worker

    def holder(self, id, beyond=0):
        """The worker that runs a job: the one that said so last."""
        def found():
            last = []
            for worker in self.workers.values():
                if worker.child.poll() is None:
                    lines = [line for line in worker.said().splitlines() if "job runs" in line and id in line]
                    last += [(re.sub(r"\x1b\[[\d;]*m", "", line)[:27], worker) for line in lines[-1:]]
            return max(last, key=lambda pair: pair[0])[1] if last else None
        return wait("a worker with the job", found)

    def replace(self, _process):
        self.work(max(self.workers) + 1)

    def taken_over(self, id, sleeper):
        wait("another worker", lambda: self.holder(id) is not sleeper)

    def logs(self, _ids):
        listed = self.s3.list_objects_v2(Bucket="vpd", Prefix="record/logs/")["Contents"]
        return [entry["Key"].rsplit("/")[-1].removesuffix(".mcap") for entry in listed]


@contextlib.contextmanager
def cluster(workers=2, slots=1, host="127.0.0.1"):
    with place(lambda folder: Cluster(folder, host)) as made:
        made.serve()
        for number in range(1, workers + 1):
            made.work(number, workers=slots)
        yield made


def test_drain():
    """A worker that is asked to stop leaves its job to another one, which goes on."""
    with cluster() as made:
        text = scenario(10 * SECOND, every=100)
        id = made.submit(text)
        made.durable(id)
        first = made.holder(id)
        begun = time.monotonic()
        assert first.stop() == 0, first.said()
        assert time.monotonic() - begun < 10 + 5
        job = made.ended(id)
        assert job["state"] == "succeeded" and job["summary"]["resumed_step"] > 0, job
        # An attempt that comes back is not counted.
        assert job["attempts"] == 1, job
        assert job["log"]["sha256"] == alone(text, made.folder)


def test_kill():
    """Workers are killed in mid-job: others go on from what is durable, and the logs are those of one machine."""
    with cluster() as made:
        kills = 200 if LARGE else 20
        text = scenario(8 * SECOND, every=100)
        wanted, waits, jobs, killed = alone(text, made.folder), [], [], 0
        number = 10
        while killed < kills:
            id = made.submit(text)
            jobs.append(id)
            durable = 0
            # Four times at most: then another job.
            for _ in range(4):
                def further(before=durable):
                    job = made.job(id)
                    return job["state"] if job["state"] == "succeeded" else max(job["progress"]["durable_step"] - before, 0)
                if killed == kills or wait("progress", further) == "succeeded":
                    break
                durable, holder = made.job(id)["progress"]["durable_step"], made.holder(id)
                holder.kill()
                killed, died = killed + 1, time.monotonic()
                made.workers = {at: worker for at, worker in made.workers.items() if worker is not holder}
                number += 1
                made.work(number)

                def again():
                    lines = [line for worker in made.workers.values() for line in worker.said().splitlines()
                             if "job runs" in line and id in line]
                    steps = [int(re.search(r"from_step=(\d+)", line)[1]) for line in lines]
                    return [step for step in steps if step >= durable]
                wait("another worker that goes on from what is durable", again)
                waits.append(time.monotonic() - died)
        for id in jobs:
            job = made.ended(id)
            assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
        listed = call(f"{made.address}/jobs?limit=500")[1]["jobs"]
        assert sorted(job["id"] for job in listed) == sorted(jobs), (listed, jobs)
        names = [entry["Key"] for page in made.s3.get_paginator("list_objects_v2").paginate(
            Bucket="vpd", Prefix="record/") for entry in page.get("Contents", [])]
        assert sum(name.endswith("result.json") for name in names) == len(jobs)
        assert sum(name.startswith("record/logs/") for name in names) == len(jobs)
        wait("the parts to go", lambda: not any(
            page.get("KeyCount") for page in [made.s3.list_objects_v2(Bucket="vpd", Prefix="record/parts/")]))
        waits.sort()
        print(f"      {killed} kills in {len(jobs)} jobs: resumed after {waits[len(waits) // 2]:.1f} s, "
              f"at most {waits[-1]:.1f} s, with a lease of {LEASE_S} s")
        assert waits[-1] <= 3 * LEASE_S, waits


# Times in which a job has to run on, in leases; numbers of slots, of workers, and of workers that are frozen; the last tells
# whether one of these holds the job, or all of them are idle. A frozen process leaves one request for jobs open.
FROZEN = [
    # With one slot the holder has no request open.
    (2, 1, 2, 1, True),
    (2, 3, 2, 1, True),
    (2, 3, 2, 1, False),
    (3, 3, 3, 2, True),
]


def test_frozen():
    """Workers are frozen, not dead, in mid-job or idle: another one runs the job within two leases, or one more for each more."""
    for leases, slots, workers, number, in_hand in FROZEN:
        waits = []
        with cluster(workers=workers, slots=slots) as made:
            text = scenario(6 * SECOND, every=100)
            wanted = alone(text, made.folder)
            for _ in range(20 if LARGE else 5):
                if in_hand:
                    id = made.submit(text)
                    made.durable(id)
                    sleepers = [made.holder(id)]
                else:
                    sleepers = []
                idle = [worker for worker in made.workers.values() if worker not in sleepers]
                sleepers += idle[:number - len(sleepers)]
                for sleeper in sleepers:
                    sleeper.send(signal.SIGSTOP)
                begun = time.monotonic()
                if not in_hand:
                    id = made.submit(text)
                wait("another worker", lambda: made.holder(id) not in sleepers)
                waits.append(time.monotonic() - begun)
                for sleeper in sleepers:
                    sleeper.send(signal.SIGCONT)
                job = made.ended(id)
                assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
                # A sleeper may have been handed the job, and finds that it is not its own any more.
                time.sleep(LEASE_S)
        print(f"      {number} of {workers} workers with {slots} slots frozen, {'one in mid-job' if in_hand else 'idle'}: the job ran after "
              + ", ".join(f"{seconds:.1f}" for seconds in sorted(waits)) + f" s; lease {LEASE_S} s")
        assert max(waits) <= leases * LEASE_S, waits


def test_listed():
    """A job that has run for more than a minute stands in the list all the while."""
    with cluster() as made:
        id = made.submit(scenario(90 * SECOND, every=100_000))
        begun, state = time.monotonic(), None
        while (since := time.monotonic() - begun) < 80:
            listed = call(f"{made.address}/jobs")[1]["jobs"]
            assert [job["id"] for job in listed] == [id], f"after {since:.0f} s: {listed}"
            state = listed[0]["state"]
            time.sleep(0.5)
        assert state == "running", state


def test_temporal_dies():
    """Temporal is killed and comes back, with what it knew and without: jobs finish."""
    with cluster() as made:
        text = scenario(5 * SECOND, every=100)
        wanted = alone(text, made.folder)
        jobs = [made.submit(text) for _ in range(4)]
        wait("a run", lambda: any(made.job(id)["progress"]["steps_done"] for id in jobs))
        made.temporal.kill()
        # Accepted jobs are in the bucket, and jobs submitted now are accepted.
        jobs.append(made.submit(text))
        time.sleep(2)
        made.temporal.start()
        made.await_temporal()
        for id in jobs:
            job = made.ended(id)
            assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
        # Everything that it knew is lost.
        for worker in made.workers.values():
            worker.kill()
        id = made.submit(text)
        made.temporal.kill()
        for path in made.folder.glob("temporal.db*"):
            path.unlink()
        made.temporal.start()
        made.await_temporal()
        made.work(3)
        made.job(id)
        assert made.ended(id)["log"]["sha256"] == wanted


class Proxy:
    """Between the program and the store: answers some requests with 500, and cuts some uploads."""

    def __init__(self, target, seed):
        self.target, self.random, self.lock = target, random.Random(seed), threading.Lock()
        self.refused = self.cut = 0
        self.share = 0.0
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address = "127.0.0.1:%d" % self.server.getsockname()[1]
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            try:
                client, _ = self.server.accept()
            except OSError:
                return
            threading.Thread(target=self.pass_on, args=(client,), daemon=True).start()

    def fate(self):
        with self.lock:
            return self.random.random() < self.share, self.random.random() < 0.5

    def pass_on(self, client):
        with contextlib.suppress(OSError), client:
            host, port = self.target.split(":")
            store = socket.create_connection((host, int(port)))
            with store:
                back = threading.Thread(target=self.copy, args=(store, client), daemon=True)
                back.start()
                head = b""
                while piece := client.recv(65536):
                    head += piece
                    # One request a connection at a time: its head is where a fate is drawn.
                    if b"\r\n\r\n" in head and re.match(rb"(PUT|POST|GET|HEAD|DELETE) ", head):
                        bad, refuse = self.fate()
                        if bad and refuse:
                            self.refused += 1
                            client.sendall(b"HTTP/1.1 500 Internal Server Error\r\ncontent-length: 0\r\n"
                                           b"connection: close\r\n\r\n")
                            return
                        if bad:
                            self.cut += 1
                            store.sendall(head[:len(head) // 2])
                            return
                    store.sendall(head)
                    head = b""

    @staticmethod
    def copy(source, target):
        with contextlib.suppress(OSError):
            while piece := source.recv(65536):
                target.sendall(piece)
            target.shutdown(socket.SHUT_WR)


def test_store_fails():
    """The store answers 500 and cuts uploads, and is killed and comes back: jobs finish with the right bytes."""
    with cluster(workers=0) as made:
        proxy = Proxy(made.s3_at, seed=7)
        env = {"AWS_ENDPOINT": f"http://{proxy.address}"}
        made.serve(name="service-2", env=env)
        for number in (1, 2):
            made.work(number, env=env)
        text = scenario(6 * SECOND, every=20)
        wanted = alone(text, made.folder)
        proxy.share = 0.2
        jobs = [made.submit(text) for _ in range(6)]
        wait("a run", lambda: any(made.job(id)["progress"]["steps_done"] for id in jobs))
        made.store.kill()
        time.sleep(3)
        made.store.start()
        for id in jobs:
            def over():
                status, job = call(f"{made.address}/jobs/{id}")
                return job if status == 200 and job["state"] == "succeeded" else None
            assert wait("the end", over)["log"]["sha256"] == wanted
        assert proxy.refused and proxy.cut
        print(f"      {proxy.refused} requests answered 500, {proxy.cut} cut off in the middle")


def test_services():
    """Two services of one record give the same answers; one that is killed loses nothing that it answered 202."""
    with cluster(workers=0) as made:
        first, at_first = made.started[-1], made.address
        jobs = [made.submit(scenario(1000)) for _ in range(20)]
        first.kill()
        made.serve("--tokens", tokens(made.folder), name="service-2")
        at_second, secret = made.address, {"authorization": f"Bearer {'s' * 20}"}
        assert at_second != at_first
        made.work(1)
        for id in jobs:
            def over():
                status, job = call(f"{at_second}/jobs/{id}", headers=secret)
                return status == 200 and job["state"] == "succeeded" and job
            job = wait("the end", over)
        # A link that one service signs opens at the other.
        made.serve("--tokens", tokens(made.folder), name="service-3")
        assert call(made.address + job["links"]["log"], raw=True)[0] == 200
        assert call(made.address + f"/jobs/{job['id']}/log.mcap", raw=True)[0] == 401


def tokens(folder):
    path = Path(folder) / "tokens"
    path.write_text(f"admin {'s' * 20}\n")
    return path


def test_sweep():
    """A sweep in parts, with a worker killed on the way: the table of one machine, byte for byte."""
    with cluster() as made:
        text = json.loads((ROOT / "scenarios/heavy-top.json").read_text())
        text.pop("expect", None)
        members = 10_000 if LARGE else 2_000
        sweep = {"scenario": text, "seed": 3, "vary": [
            {"pointer": "/scene/initial/attitude/axis_angle/angle_rad",
             "values": {"linear": {"from": 0.1, "to": 3.1, "count": members}}}]}
        path = made.folder / "sweep.json"
        path.write_text(json.dumps(sweep))
        alone, together = made.folder / "alone.csv", made.folder / "together.csv"
        begun = time.monotonic()
        subprocess.run([VPD, "sweep", path, "-o", alone], check=True, stdout=subprocess.DEVNULL)
        alone_s, begun = time.monotonic() - begun, time.monotonic()
        client = made.run("sweep", [VPD, "sweep", path, "-o", together, "--engine", "cluster", *made.together()], made.env)
        wait("a part", lambda: "part of a sweep made" in made.workers[1].said())
        made.workers[1].kill()
        made.work(3)
        # The calling command is killed as well: the same command goes on.
        client.kill()
        client.start()
        assert client.child.wait(timeout=PATIENCE_S) == 0, client.said()
        parts = sum(worker.said().count("part of a sweep made") for worker in [*made.workers.values()])
        print(f"      {members} members in about {parts} parts: {time.monotonic() - begun:.1f} s, alone {alone_s:.1f} s")
        assert together.read_bytes() == alone.read_bytes()
        again = subprocess.run([VPD, "sweep", path, "-o", together, "--engine", "cluster", *made.together()],
                               env=made.env | os.environ, capture_output=True, text=True)
        assert again.returncode == 2 and "--force" in again.stderr, again.stderr


@contextlib.contextmanager
def hosts(number):
    """Hosts with networks of their own, on one bridge: its address, their names and their lines."""
    mark = f"v{os.getpid() % 10_000}"

    def do(*words):
        subprocess.run(words, check=True)

    try:
        do("ip", "link", "add", f"{mark}b", "type", "bridge")
        do("ip", "address", "add", "10.231.7.1/24", "dev", f"{mark}b")
        do("ip", "link", "set", f"{mark}b", "up")
        names = [f"{mark}h{at}" for at in range(number)]
        for at, name in enumerate(names):
            do("ip", "netns", "add", name)
            do("ip", "link", "add", f"{name}o", "type", "veth", "peer", "name", f"{name}i", "netns", name)
            do("ip", "link", "set", f"{name}o", "master", f"{mark}b", "up")
            do("ip", "-n", name, "address", "add", f"10.231.7.{at + 2}/24", "dev", f"{name}i")
            do("ip", "-n", name, "link", "set", f"{name}i", "up")
            do("ip", "-n", name, "link", "set", "lo", "up")
        yield "10.231.7.1", names, [f"{name}o" for name in names]
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], stderr=subprocess.DEVNULL)
        subprocess.run(["ip", "link", "del", f"{mark}b"], stderr=subprocess.DEVNULL)


def test_hosts():
    """Two hosts: one is cut off in mid-job and comes back, the other has a slow line; one result, of the right bytes."""
    if os.geteuid() != 0 or not shutil.which("ip") or not shutil.which("tc"):
        print("      SKIPPED: networks of their own need root, ip and tc (on Debian: apt-get install iproute2)")
        return
    with hosts(2) as (host, names, lines), cluster(workers=0, host=host) as made:
        for number, name in enumerate(names):
            made.work(number, prefix=["ip", "netns", "exec", name])
        text = scenario(12 * SECOND, every=1000)
        wanted = alone(text, made.folder)
        id = made.submit(text)
        made.durable(id)
        cut = made.holder(id)
        at = next(at for at, worker in made.workers.items() if worker is cut)
        # The other one has to fetch what is durable over a line of 4 Mbit/s.
        slow = ["tc", "qdisc", "add", "dev", lines[1 - at], "root", "tbf", "rate", "4mbit", "burst", "32kbit", "latency", "400ms"]
        subprocess.run(slow, check=True)
        subprocess.run(["ip", "link", "set", lines[at], "down"], check=True)
        wait("the other host", lambda: made.holder(id) is not cut)
        subprocess.run(["ip", "link", "set", lines[at], "up"], check=True)
        job = made.ended(id)
        assert (job["state"], job["log"]["sha256"]) == ("succeeded", wanted), job
        wait("the host that was cut off", lambda: "job goes back" in cut.said() or "job ended" in cut.said())
        assert made.logs([id]) == [wanted]


def test_refused():
    """What is missing or wrong is refused with exit code 2, and named."""
    for given, named in [
        (["serve", "--engine", "cluster"], "--bucket"),
        (["serve", "--engine", "cluster", "--bucket", "file:///tmp/x"], "--temporal"),
        (["serve", "--bucket", "file:///tmp/x"], "--bucket"),
        (["serve", "--engine", "cluster", "--bucket", "ftp://x", "--temporal", "127.0.0.1:1"], "ftp://x"),
        (["serve", "--lease-s", "3.9"], "--lease-s"),
        (["serve", "--engine", "cluster", "--foxglove-listen", "127.0.0.1:0"], "--foxglove-listen"),
        (["worker"], "--bucket"),
        (["worker", "--bucket", "s3://x", "--workers", "0"], "--workers"),
        (["worker", "--bucket", "s3://x", "--task-queue", "q" * 201], "--task-queue"),
        (["sweep", ROOT / "scenarios/sweeps/pendulum-chaos.json", "--engine", "cluster"], "--bucket"),
        (["sweep", ROOT / "scenarios/sweeps/pendulum-chaos.json", "--engine", "cluster", "--shard", "1/2"], "--shard"),
    ]:
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run([VPD, *map(str, given)], cwd=folder, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2 and named in done.stderr, (given, done.returncode, done.stderr)


def test_deploy():
    """The manifests: what they start serves and works, and every variable they set is one that is read."""
    started = []
    compose = yaml.safe_load((ROOT / "deploy/compose.yaml").read_text())
    for service in compose["services"].values():
        if service["image"] == "vpd":
            started.append((service["command"], service["environment"]))
    parts = [part for path in sorted((ROOT / "deploy/kubernetes").glob("*.yaml"))
             for part in yaml.safe_load_all(path.read_text())]
    held = {part["kind"]: part.get("data") or part.get("stringData") for part in parts
            if part["kind"] in ("ConfigMap", "Secret")}
    for part in parts:
        if part["kind"] == "Deployment":
            pod = part["spec"]["template"]["spec"]
            assert part["spec"]["selector"]["matchLabels"] == part["spec"]["template"]["metadata"]["labels"]
            started += [(container["args"], held["ConfigMap"] | held["Secret"]) for container in pod["containers"]]
    assert [words[0] for words, _ in started] == ["serve", "worker"] * 2, started
    read = {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_REGION", "AWS_ENDPOINT", "AWS_ALLOW_HTTP",
            "TEMPORAL_NAMESPACE", "VPD_TOKENS"}
    for command in ["serve", "worker"]:
        helped = subprocess.run([VPD, command, "--help"], capture_output=True, text=True, check=True).stdout
        read |= set(re.findall(r"\[env: (\w+)=", helped))
    with cluster(workers=0) as made:
        for number, (words, env) in enumerate(started):
            assert set(env) <= read, set(env) - read
            here = {"VPD_SCRATCH": str(made.folder / f"here-{number}"), "TEMPORAL_ADDRESS": made.temporal_at,
                    "VPD_TOKENS": f"admin {'s' * 20}", "VPD_LISTEN": "127.0.0.1:0", "VPD_DATA": str(made.folder / f"here-{number}")}
            words = [str(made.folder / f"here-{number}") if word == "/data" else word for word in words]
            process = made.run(f"here-{number}", [VPD, *words], env | made.env | here)
            wanted = r"listening on (\S+)" if words[0] == "serve" else r'works( queue|","queue)'
            wait("a start", lambda: re.search(wanted, process.said()), 60)


def test_share():
    """Many jobs over two workers: fair, and not much slower than on one machine."""
    for count, steps in [(2000, SECOND // 4), (400, SECOND)] if LARGE else [(30, 2 * SECOND)]:
        text = scenario(steps, every=20_000)
        with cluster() as made:
            seconds, submitted_s = all_of(made, text, count)
            shares = [worker.said().count("job ended") for worker in made.workers.values()]
        with local() as made:
            # Enough to know how quick it is.
            alone_s, _ = all_of(made, text, min(count, 300))
        print(f"      {count} jobs, one every {seconds:.3f} s ({submitted_s:.1f} s to submit), alone every {alone_s:.3f} s: "
              f"{100 * alone_s / seconds:.0f} %; shares {shares}")
        assert sum(shares) == count and abs(shares[0] - shares[1]) <= 0.2 * count, shares


def all_of(bench, text, count):
    """Seconds for each of `count` jobs, and for submitting them all."""
    begun = time.monotonic()
    jobs = [bench.submit(text) for _ in range(count)]
    submitted_s = time.monotonic() - begun
    for id in jobs:
        bench.ended(id, 3600)
    return (time.monotonic() - begun) / count, submitted_s


class Spent:
    """What servers, service and workers have spent: CPU seconds each, requests to the store, memory now."""

    def __init__(self, made):
        self.made = made
        self.cpu_s = {process.name: self.cpu(process) for process in made.started}
        text = call(f"http://{made.host}:{made.metrics}/metrics", raw=True)[1].decode()
        self.requests = sum(float(line.split()[-1]) for line in text.splitlines()
                            if line.startswith("SeaweedFS_s3_request_total{"))

    @staticmethod
    def cpu(process):
        fields = Path(f"/proc/{process.child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def since(self, before):
        """CPU by kind of process, and requests."""
        by_kind = {}
        for name, seconds in self.cpu_s.items():
            kind = name.split("-")[0]
            by_kind[kind] = by_kind.get(kind, 0.0) + seconds - before.cpu_s[name]
        return by_kind, self.requests - before.requests


def memory_mb(process):
    status = Path(f"/proc/{process.child.pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1e3


def test_capacity():
    """What a job takes of store, Temporal, service and worker, and how quickly a log gets into the store."""
    with cluster(slots=4) as made:
        # A worker's first job also sets it up.
        for id in [made.submit(scenario(1000)) for _ in range(8)]:
            made.ended(id)
        count = 1000 if LARGE else 100
        before, begun = Spent(made), time.monotonic()
        for _ in range(count):
            made.submit(scenario(1000))
        submitted_s = time.monotonic() - begun
        wait("the jobs", lambda: f'vpd_jobs{{state="succeeded"}} {count + 8}' in call(
            f"{made.address}/metrics", raw=True)[1].decode(), 3600)
        took_s = time.monotonic() - begun
        cpu_s, requests = Spent(made).since(before)
        command = [BIN / "temporal", "workflow", "list", "--address", made.temporal_at, "--output", "json", "--limit", "50"]
        listed = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
        events = [int(flow["historyLength"]) for flow in listed]
        print(f"      {count} jobs of milliseconds in {took_s:.1f} s ({submitted_s:.1f} s to submit): {count / took_s:.1f} jobs/s; "
              f"a job takes {requests / count:.1f} requests to the store, {max(events)} events of Temporal, CPU ms: "
              + ", ".join(f"{kind} {1e3 * seconds / count:.1f}" for kind, seconds in cpu_s.items()))
        before, begun = Spent(made), time.monotonic()
        logs = [made.ended(made.submit(scenario(400_000 if LARGE else 100_000, every=1)))["log"]["bytes"] for _ in range(4)]
        took_s = time.monotonic() - begun
        cpu_s, _ = Spent(made).since(before)
        print(f"      four logs of {logs[0] / 1e6:.0f} MB, one after the other: {sum(logs) / took_s / 1e6:.1f} MB/s; a gigabyte takes CPU s: "
              + ", ".join(f"{kind} {1e9 * seconds / sum(logs):.0f}" for kind, seconds in cpu_s.items()))
        print("      memory, MB: " + ", ".join(f"{process.name} {memory_mb(process):.0f}" for process in made.started))
        assert requests / count <= 16, requests / count
        assert events and max(events) <= 12, events


def main():
    wanted = [word for word in sys.argv[1:] if not word.startswith("-")]
    tests = on(cluster) | {name.removeprefix("test_"): test for name, test in globals().items() if name.startswith("test_")}
    unknown = [name for name in wanted if name not in tests]
    if unknown:
        sys.exit(f"there is no test {unknown[0]}; there are {', '.join(tests)}")
    report({name: tests[name] for name in wanted or tests})


if __name__ == "__main__":
    main()

"""Sends the service what its own description allows and forbids, and checks every answer against it.

    python check_api.py VPD CASES [SEED]

Starts the binary VPD on a port of its own with a few finished jobs, and runs schemathesis on its
/openapi.json. Fails on a server error, on an answer that the description does not know, and if there were
fewer than CASES cases.
"""

import json
import pathlib
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request

HERE = pathlib.Path(__file__).parent
SCENARIO = HERE.parent.parent / "scenarios" / "heavy-top.json"


def ask(url, body=None):
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)


def finished_job(base):
    job = ask(f"{base}/jobs", SCENARIO.read_bytes())
    while job["state"] in ("queued", "running"):
        time.sleep(0.05)
        job = ask(f"{base}/jobs/{job['id']}")
    return job["id"]


def check(vpd, cases, seed, folder):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    base = f"http://127.0.0.1:{port}"
    log = open(folder / "log", "w+", encoding="utf-8")
    service = subprocess.Popen(
        [vpd, "serve", "--listen", f"127.0.0.1:{port}", "--data", folder / "data",
         "--requests-per-s", "1000000", "--connections-per-client", "1000"],
        stderr=log,
    )
    try:
        for _ in range(500):
            try:
                ask(f"{base}/healthz")
                break
            except OSError:
                time.sleep(0.02)
        job = finished_job(base)
        # All but the deletion look at a job that is there.
        config = folder / "schemathesis.toml"
        config.write_text(
            f'[parameters]\n"path.id" = "{job}"\n\n'
            '[[operations]]\ninclude-name = "DELETE /jobs/{id}"\n'
            'parameters = { "path.id" = "01999999-9999-7999-8999-999999999999" }\n\n'
            # A scenario may be of the right form and still describe no body.
            '[checks]\npositive_data_acceptance.expected-statuses = ["2xx", 404, 409, 422]\n'
            # The example of a study is a real one, and the queue of studies is short.
            '[[operations]]\ninclude-name = "POST /studies"\n'
            'checks.positive_data_acceptance.expected-statuses = ["2xx", 422, 429]\n'
        )
        run = subprocess.run(
            [pathlib.Path(sys.executable).parent / "schemathesis", "--config-file", config, "run",
             f"{base}/openapi.json", "--max-examples", str(max(1, cases // 10)), "--seed", str(seed),
             # The job that is deleted is not the one that was made.
             "--exclude-checks", "ensure_resource_availability",
             "--continue-on-failure", "--no-color"],
            capture_output=True, text=True, check=False, cwd=folder,
        )
        print(run.stdout[-20000:], run.stderr[-1000:])
        made = re.search(r"(\d+) generated", run.stdout)
        made = int(made.group(1)) if made else 0
        log.seek(0)
        errors = [line for line in log if "ERROR" in line]
        print(f"{made} cases, {len(errors)} errors in the service's log")
        return run.returncode == 0 and made >= cases and not errors and ask(f"{base}/healthz")
    finally:
        service.terminate()
        service.wait(timeout=20)


def main():
    vpd, cases = pathlib.Path(sys.argv[1]).resolve(), int(sys.argv[2])
    seed = int(sys.argv[3]) if len(sys.argv) > 3 else time.time_ns() % 2**32
    with tempfile.TemporaryDirectory() as folder:
        return 0 if check(vpd, cases, seed, pathlib.Path(folder)) else 1


if __name__ == "__main__":
    sys.exit(main())

"""A service of the tests' own, for the clients in Python."""

import contextlib
import json
import os
import re
import subprocess
import tempfile
import urllib.request

VPD = os.path.abspath(os.environ.get("VPD", "target/release/vpd"))


@contextlib.contextmanager
def serving(*args, live=False, env=None):
    """Runs `vpd serve` on a free port; gives its address, and that for viewers if it is `live`."""
    with tempfile.TemporaryDirectory() as data:
        command = [VPD, "serve", "--listen", "127.0.0.1:0", "--data", data, *args]
        command += ["--foxglove-listen", "127.0.0.1:0"] if live else []
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | (env or {}))
        try:
            patterns = [r"listening on (http://[\d.:]+)"]
            patterns += [r"viewers may connect to (ws://[\d.:]+)"] if live else []
            found = awaited(process, patterns)
            yield found if live else found[0]
        finally:
            process.terminate()
            process.communicate(timeout=30)


def awaited(process, patterns):
    """What stands in the first lines of a service's own log that have it, whichever comes first."""
    lines, found = [], {}
    for line in process.stderr:
        lines.append(line)
        found |= {pattern: hit[1] for pattern in patterns if (hit := re.search(pattern, line))}
        if len(found) == len(patterns):
            return [found[pattern] for pattern in patterns]
    raise RuntimeError("vpd serve ended: " + "".join(lines))


def call(url, body=None, method=None, headers=None):
    """One request; JSON in, JSON out."""
    data = None if body is None else json.dumps(body).encode()
    headers = {"content-type": "application/json"} | (headers or {})
    request = urllib.request.Request(url, data=data, headers=headers, method=method)
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.loads(answer.read() or b"null")

"""Carries out the lines of the Dockerfile without Docker.

    python dockerfile.py

The build stage runs in this tree. The last stage runs in a throw-away overlay of this machine's root, as root in
a mount namespace of its own: nothing of it stays. Its command must serve, as the user it names, until the health
check says so; and it must refuse to serve other machines without a token.
"""

import json
import os
import re
import shlex
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OVERLAY = """
set -e
place=$(mktemp -d); mount -t tmpfs none "$place"; mkdir "$place"/up "$place"/work "$place"/whole
mount -t overlay overlay -o lowerdir=/,upperdir="$place"/up,workdir="$place"/work "$place"/whole
mount -t proc proc "$place"/whole/proc; mount --bind /dev "$place"/whole/dev
exec chroot "$place"/whole bash -e
"""


def stages(text):
    """Stages as lists of (word, rest)."""
    text = re.sub(r"\\\n\s*", " ", text)
    given = dict(line.split()[1].split("=", 1) for line in text.splitlines() if re.match(r"ARG \w+=", line))
    text = re.sub(r"\$\{(\w+)\}", lambda found: given[found[1]], text)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    found = []
    for line in lines:
        word, rest = line.split(maxsplit=1)
        if word == "ARG":
            continue
        if word == "FROM":
            found.append([])
        found[-1].append((word, rest))
    return found


def example(text):
    """What the comment of the Dockerfile gives in VPD_TOKENS, as a shell makes it."""
    lines = [line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#")]
    token = next(line for line in lines if line.startswith("TOKEN="))
    given = next(found[1] for line in lines if (found := re.search(r"-e VPD_TOKENS=(\S+ \S+)", line)))
    done = subprocess.run(["bash", "-euc", f"{token}; printf %s {given}"], capture_output=True, text=True, check=True)
    return done.stdout


def value(stage, wanted):
    return [rest for word, rest in stage if word == wanted]


def overlay(script):
    """Runs a script as root of a throw-away copy of this machine; its exit code and its words."""
    command = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "bash", "-c", OVERLAY]
    done = subprocess.run(command, input=script, text=True, timeout=120,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    return done.returncode, done.stdout


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def check(name, good, detail=""):
    print(f"{'pass' if good else 'FAIL'}  {name}{': ' if detail else ''}{detail}")
    return bool(good)


def main():
    text = (ROOT / "Dockerfile").read_text()
    build, last = stages(text)
    tokens = example(text)
    for command in value(build, "RUN"):
        subprocess.run(command, shell=True, cwd=ROOT, check=True)

    # Where the build stage left its files, in this tree.
    copies = []
    for rest in value(last, "COPY"):
        source, target = rest.removeprefix("--from=build ").split()
        copies.append(f"install -m 755 {ROOT / Path(source).relative_to('/src')} {target}")
    user, port = value(last, "USER")[0], free_port()
    env = " ".join(value(last, "ENV")).replace(":8080", f":{port}")
    health = json.loads(value(last, "HEALTHCHECK")[0].split("CMD ")[1])
    health = shlex.join(part.replace("/8080", f"/{port}") for part in health)
    command = shlex.join(json.loads(value(last, "ENTRYPOINT")[0]) + json.loads(value(last, "CMD")[0]))
    as_user = f"setpriv --reuid {user} --regid {user} --clear-groups --inh-caps=-all env -i PATH=/usr/bin:/usr/local/bin"
    script = "\n".join([
        *value(last, "RUN"), *copies,
        f"echo refused $({as_user} {env} timeout 10 {command} > /dev/null 2>&1; echo $?)",
        f"{as_user} {env} VPD_TOKENS={shlex.quote(tokens)} {command} > /tmp/vpd.log 2>&1 &",
        f"for i in $(seq 100); do if {as_user} {health}; then echo healthy; break; fi 2>/dev/null; sleep 0.1; done",
        "echo owner $(ps -o user= -p $!) data $(stat -c %U:%a /data)",
        "kill $!; wait $!; echo stopped $?",
    ])
    begun = time.monotonic()
    code, out = overlay(script)
    good = check("the steps were carried out", code == 0, f"{time.monotonic() - begun:.1f} s")
    good &= check("without a token it refuses to serve other machines", "refused 2" in out)
    good &= check("with the token of its comment the health check passes", "healthy" in out)
    good &= check("it runs as its own user, on its own data", f"owner {user} data {user}:700" in out)
    good &= check("it stops in order", "stopped 0" in out)
    if not good:
        print(out)
    return 0 if good else 1


if __name__ == "__main__":
    if os.geteuid() != 0:
        print("FAIL  the steps of an image need root: run the tests in a container, or with sudo")
        sys.exit(1)
    sys.exit(main())

"""Runs what the documentation says to type, as they would.

    python docs.py FILE.md...

The blocks of a file are run one after another in a directory that holds the shipped scenarios:
```sh is run by bash, with `vpd` the program, a service of the test in the place of localhost:8080, and the newest
job in the place of ID; one that serves has to begin to listen; one with `fails` has to fail; one with `skip`
belongs to the tree and is left out.
```json is a scenario, or a sweep if it varies something, and must be accepted, under the name that follows if one does.
```python is run by Python, the blocks of a page in one session, with the same in the place of localhost:8080 and ID.
Blocks without a language, or of another one, are what a program answered.
"""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from service import VPD, call, serving

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```(sh|json|python)([^\n]*)\n(.*?)^```$", re.S | re.M)


def newest(url):
    jobs = call(f"{url}/jobs?limit=1")["jobs"]
    return jobs[0]["id"] if jobs else ""


def settle(url):
    """Waits until no job runs: a person would look first, too."""
    while any(call(f"{url}/jobs?state={state}&limit=1")["jobs"] for state in ("queued", "running")):
        time.sleep(0.05)


def serves(command, place, env):
    """Whether a service begins to listen; on any port, for this machine may have others."""
    command = re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:0", command)
    process = subprocess.Popen(["bash", "-euc", f"exec {command.strip()}"], cwd=place, env=env, text=True,
                               stderr=subprocess.PIPE)
    try:
        return any("listening on" in line for line in process.stderr)
    finally:
        process.terminate()
        process.communicate(timeout=30)


def here(text, url):
    """What people would type to the service of the test."""
    text = text.replace("localhost:8080", url.removeprefix("http://"))
    return re.sub(r"\bID\b", newest(url), text)


def run(page, url, place):
    """Runs the blocks of a page; how many there were."""
    env = os.environ
    count, session = 0, {}
    for kind, words, text in BLOCK.findall(page.read_text()):
        if "skip" in words:
            continue
        count += 1
        if kind == "json":
            file = place / (words.strip() or "block.json")
            file.write_text(text)
            command = f"vpd sweep {file.name} --member 0" if '"vary"' in text else f"vpd plan {file.name} > {file.name}.plan"
        elif kind == "python":
            settle(url)
            try:
                with contextlib.chdir(place), contextlib.redirect_stdout(io.StringIO()):
                    exec(compile(here(text, url), str(page), "exec"), session)
            except Exception:
                print(f"FAIL  {page}:\n{text}\n{traceback.format_exc()}")
                return count, False
            continue
        elif text.startswith("vpd serve"):
            if not serves(text, place, env):
                print(f"FAIL  {page}: does not serve:\n{text}")
                return count, False
            continue
        else:
            settle(url)
            command = here(text, url)
        done = subprocess.run(["bash", "-euo", "pipefail", "-c", command], cwd=place, env=env,
                              capture_output=True, text=True, timeout=120)
        failed = done.returncode != 0 or '"urn:vpd:problem' in done.stdout
        if failed != ("fails" in words):
            print(f"FAIL  {page}:\n{command}\n{done.stdout}{done.stderr}")
            return count, False
    return count, True


def main():
    good, total = True, 0
    # Plots need no screen.
    os.environ |= {"PATH": f"{Path(VPD).parent}:{os.environ['PATH']}", "MPLBACKEND": "Agg"}
    for name in sys.argv[1:]:
        page = Path(name)
        # A command that is not in a block of its own would not be run.
        loose = [line for line in BLOCK.sub("", page.read_text()).splitlines() if line.startswith("    curl ")]
        with tempfile.TemporaryDirectory() as place, serving() as url:
            shutil.copytree(ROOT / "scenarios", Path(place) / "scenarios")
            count, fine = run(page, url, Path(place))
        fine &= not loose
        good &= fine
        total += count
        print(f"{'pass' if fine else 'FAIL'}  {name}: {count} blocks run{', not run: ' if loose else ''}{loose or ''}")
    return 0 if good and total else 1


if __name__ == "__main__":
    sys.exit(main())

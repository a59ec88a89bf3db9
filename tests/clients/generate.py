"""Clients made from the description of the API by other people's generators, and used.

    python generate.py
"""

import importlib
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from service import call, serving

ROOT = Path(__file__).resolve().parents[2]
NODE = ROOT / "target/clients/node_modules"
# Media types that openapi-python-client knows under another name.
CONFIG = """
content_type_overrides:
  image/svg+xml: application/octet-stream
  application/openmetrics-text; version=1.0.0; charset=utf-8: text/plain
  application/openmetrics-text: text/plain
post_hooks: []
"""
# Code as users would write it; the compiler holds it against the description.
USE = """
import type { components, operations, paths } from "./api";
type Schemas = components["schemas"];
export const seen = (job: Schemas["Job"]): number => {
  const steps: number = job.summary?.steps ?? job.plan?.steps ?? 0;
  const energy: number | undefined = job.summary?.energy?.max_abs_error;
  const code: string | undefined = job.diagnosis?.code;
  const state: "queued" | "running" | "succeeded" | "failed" | "cancelled" = job.state;
  return state === "failed" ? (code ?? "").length : steps + (energy ?? 0);
};
export const spin: Schemas["Framed"] = { body: [0, 0, 1] };
export const term: Schemas["PotentialTerm"] =
  { kind: "uniform", weight: 1, body_point: [0, 0, 1], direction: [0, 0, 1] };
// @ts-expect-error: another frame there is not.
export const wrong: Schemas["Framed"] = { moon: [0, 0, 1] };
export type Sent = operations["submitJob"]["requestBody"]["content"]["application/json"];
export type Taken = paths["/jobs"]["post"]["responses"][202]["content"]["application/json"];
export const id = (taken: Taken): string => taken.id;
export const scenario: Sent = { name: "spin", scene: { inertia: { principal: [1, 2, 3] }, initial: { momentum: spin } },
  step_s: 0.01, steps: 10 };
"""


def check(name, good, detail=""):
    print(f"{'pass' if good else 'FAIL'}  {name}{': ' if detail else ''}{detail}")
    return bool(good)


def python_client(url, api, place):
    (place / "config.yml").write_text(CONFIG)
    (place / "api.json").write_text(json.dumps(api))
    made = subprocess.run(
        [sys.executable, "-m", "openapi_python_client", "generate", "--path", "api.json", "--output-path", "vpd_client",
         "--meta", "none", "--config", "config.yml"], cwd=place, capture_output=True, text=True, check=False)
    said = made.stdout + made.stderr
    good = check("openapi-python-client makes a client without a warning",
                 made.returncode == 0 and not re.search("warning|error", said, re.I), said.strip()[:2000])
    if made.returncode != 0:
        return False
    names = [path.stem for path in (place / "vpd_client/models").glob("*.py")]
    unreadable = [name for name in names if re.search(r"type_\d|_\d$", name)]
    good &= check("its classes have readable names", not unreadable and len(names) > 50,
                  ", ".join(unreadable) or f"{len(names)} of them")

    sys.path.insert(0, str(place))
    client = importlib.import_module("vpd_client").Client(base_url=url)
    models = importlib.import_module("vpd_client.models")
    def ask(tag, name):
        return importlib.import_module(f"vpd_client.api.{tag}.{name}").sync
    example = api["paths"]["/jobs"]["post"]["requestBody"]["content"]["application/json"]["example"]
    example["steps"] = 500
    example.pop("expect", None)
    job = ask("jobs", "submit_job")(client=client, body=models.Scenario.from_dict(example))
    while not (job := ask("jobs", "get_job")(job.id, client=client)).state.value in ("succeeded", "failed"):
        time.sleep(0.05)
    good &= check("a job sent with it succeeds, and plan and summary are typed",
                  isinstance(job.plan, models.Plan) and isinstance(job.summary, models.Summary)
                  and job.summary.steps == 500 and job.plan.formulation.order == 4,
                  f"{job.state.value}, {job.summary.steps} steps")
    # One that fails in its first step.
    example["step_s"] = 50.0
    job = ask("jobs", "submit_job")(client=client, body=models.Scenario.from_dict(example))
    while not (job := ask("jobs", "get_job")(job.id, client=client)).state.value in ("succeeded", "failed"):
        time.sleep(0.05)
    good &= check("why a job failed is typed", isinstance(job.diagnosis, models.Diagnosis) and job.diagnosis.step >= 1,
                  f"{job.state.value}: {job.diagnosis.code}")
    example["step_s"] = -1.0
    problem = ask("jobs", "submit_job")(client=client, body=models.Scenario.from_dict(example))
    good &= check("a problem is typed", isinstance(problem, models.Problem) and problem.pointer == "/step_s", problem.code)
    page = ask("jobs", "list_jobs")(client=client, limit=10)
    return good & check("lists are typed", len(page.jobs) == 2 and isinstance(page.jobs[0], models.Job))


def typescript(place):
    (place / "use.ts").write_text(USE)
    made = subprocess.run([NODE / ".bin/openapi-typescript", "api.json", "-o", "api.d.ts",
                           # Fields with a default may be left out of a request.
                           "--default-non-nullable", "false"], cwd=place,
                          capture_output=True, text=True, check=False)
    good = check("openapi-typescript makes types", made.returncode == 0, made.stderr.strip()[:500])
    held = subprocess.run([NODE / ".bin/tsc", "--noEmit", "--strict", "--skipLibCheck", "false", "use.ts"], cwd=place,
                          capture_output=True, text=True, check=False)
    return good & check("what is written with them compiles, and what is wrong does not", held.returncode == 0,
                        held.stdout.strip()[:2000])


def main():
    with tempfile.TemporaryDirectory() as folder, serving() as url:
        api = call(f"{url}/openapi.json")
        good = python_client(url, api, Path(folder))
        good &= typescript(Path(folder))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

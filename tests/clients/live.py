"""The live view through a raw WebSocket client: the protocol of Foxglove, a running job, its samples, who is let in.

    python live.py
"""

import asyncio
import base64
import json
import struct
import sys

import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from service import call, serving

PROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
TOKEN = "a-token-of-the-tests"
TOPICS = ["/state", "/energy", "/tf", "/scene/body"]


def decoder(channel):
    """The class of a channel's messages, from the schema that the server sends."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


async def watch(address, url, protocol):
    async with websockets.connect(address, subprotocols=[protocol]) as socket:
        assert socket.subprotocol == protocol
        info = json.loads(await socket.recv())
        assert info["op"] == "serverInfo" and "time" in info["capabilities"], info
        channels = {}
        while not set(TOPICS) <= channels.keys():
            message = await asyncio.wait_for(socket.recv(), 30)
            if isinstance(message, str) and json.loads(message)["op"] == "advertise":
                channels |= {c["topic"]: c for c in json.loads(message)["channels"]}
        numbers = dict(enumerate(TOPICS))
        wanted = [{"id": k, "channelId": channels[t]["id"]} for k, t in numbers.items()]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

        scenario = call(f"{url}/scenarios/dipole")
        del scenario["expect"]
        job = call(f"{url}/jobs", scenario | {"steps": 100_000_000, "log": {"every": 1000}})
        seen, clock = {topic: [] for topic in TOPICS}, []

        def enough():
            # The clock goes another way than the samples, and may come behind them.
            last = max((time_ns for time_ns, _ in seen["/state"]), default=0)
            return len(seen["/tf"]) >= 20 and seen["/scene/body"] and last in clock

        while not enough():
            message = await asyncio.wait_for(socket.recv(), 30)
            if isinstance(message, str):
                continue
            if message[0] == 1:
                number, time_ns = struct.unpack("<IQ", message[1:13])
                seen[numbers[number]].append((time_ns, message[13:]))
            elif message[0] == 2:
                clock.append(struct.unpack("<Q", message[1:9])[0])
        call(f"{url}/jobs/{job['id']}/cancel", method="POST")

    states = [(t, decoder(channels["/state"]).FromString(data)) for t, data in seen["/state"]]
    frames = [decoder(channels["/tf"]).FromString(data) for _, data in seen["/tf"]]
    epoch = 1767225600000000000
    off = max(abs(t - epoch - state.time_s * 1e9) for t, state in states)
    assert off <= 1, f"log time is off by {off} ns"
    assert all(a < b for (a, _), (b, _) in zip(states, states[1:])), "time falls"
    assert clock == sorted(clock) and set(t for t, _ in states) <= set(clock), "the clock"
    turns = {(f.transforms[0].rotation.w, f.transforms[0].rotation.x) for f in frames}
    assert len(turns) > 10, "the body does not turn"
    print(f"pass  live view, {protocol}: {len(frames)} frames, {len(seen['/scene/body'])} drawings, {len(clock)} times")


async def knock(address, **options):
    """101 for who is let in, else the status."""
    try:
        async with websockets.connect(address, **({"subprotocols": PROTOCOLS} | options)):
            return 101
    except websockets.exceptions.InvalidStatus as refused:
        return refused.response.status_code


async def guard(address, url):
    """The door where there are tokens, and pages are named."""
    token = {"authorization": f"Bearer {TOKEN}"}
    scenario = call(f"{url}/scenarios/dipole", headers=token)
    del scenario["expect"]
    scenario |= {"steps": 100_000_000, "log": {"every": 1000}}
    job = call(f"{url}/jobs", scenario, headers=token)["id"]
    while (seen := call(f"{url}/jobs/{job}", headers=token))["state"] != "running":
        await asyncio.sleep(0.05)
    link = seen["links"]["live_viewers"]["address"]
    assert link.startswith(f"{address}/?expires=") and TOKEN not in json.dumps(seen)
    port = address.rsplit(":", 1)[1]
    for name, wanted, place, options in [
        ("a link", 101, link, {}),
        ("a token", 101, address, {"additional_headers": token}),
        ("a page that was named", 101, link, {"origin": "https://app.foxglove.dev"}),
        ("no token", 401, address, {}),
        ("another signature", 401, link[:-4] + "0000", {}),
        ("another page", 403, link, {"origin": "https://evil.example"}),
        ("another name", 421, link.replace("127.0.0.1", "evil.example"), {"host": "127.0.0.1", "port": int(port)}),
        ("another protocol", 400, link, {"subprotocols": ["other.v1"]}),
    ]:
        status = await knock(place, **options)
        assert status == wanted, f"{name}: {status}"
        print(f"pass  {name}: {status}")
    call(f"{url}/jobs/{job}/cancel", method="POST", headers=token)


def main():
    with serving(live=True) as (url, address):
        for protocol in PROTOCOLS:
            asyncio.run(watch(address, url, protocol))
    named = ["--cors", "https://app.foxglove.dev"]
    with serving(*named, live=True, env={"VPD_TOKENS": f"admin {TOKEN}"}) as (url, address):
        asyncio.run(guard(address, url))


if __name__ == "__main__":
    sys.exit(main())

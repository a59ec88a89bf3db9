"""The live view through a raw WebSocket client: the protocol of Foxglove's SDK, a running job, its samples.

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

TOPICS = ["/state", "/energy", "/tf", "/scene/body"]


def decoder(channel):
    """The class of a channel's messages, from the schema that the server sends."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


async def watch(address, url):
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"]) as socket:
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
    print(f"pass  live view: {len(frames)} frames, {len(seen['/scene/body'])} drawings, {len(clock)} times")


async def refuse_old(address):
    try:
        async with websockets.connect(address, subprotocols=["foxglove.websocket.v1"]):
            pass
    except websockets.exceptions.InvalidStatus as refused:
        print(f"pass  the old protocol is refused: {refused.response.status_code}")
        return
    raise AssertionError("the old protocol was taken")


def main():
    with serving(live=True) as (url, address):
        asyncio.run(watch(address, url))
        asyncio.run(refuse_old(address))


if __name__ == "__main__":
    sys.exit(main())

"""A WebSocket client of Foxglove's protocol: takes what is advertised, decodes it by the schemas that are advertised with it.

Prints two JSON objects, a line each: what came of the current map at once, and then, for maps made from now on, the points.

Usage: foxglove_live.py URL
"""

import asyncio
import base64
import json
import sys

import told as tell
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.asyncio.client import connect

LATER = "/car/points"


def decoder(channel):
    assert channel["encoding"] == "protobuf" and channel["schemaEncoding"] == "protobuf", channel
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString


async def receive(socket, decoders, wanted):
    """One message of each of these subscriptions."""
    told = {}
    while set(told) < wanted:
        frame = await socket.recv()
        if isinstance(frame, str):
            continue
        assert frame[0] == 1, frame[0]
        subscription = int.from_bytes(frame[1:5], "little")
        log_ns = int.from_bytes(frame[5:13], "little")
        if subscription in wanted:
            message = decoders[subscription](frame[13:])
            told.setdefault(subscription, {"log_ns": log_ns, **tell.protobuf(message)})
    return told


async def main(url):
    async with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        assert socket.subprotocol == "foxglove.sdk.v1"
        channels = {}
        info = json.loads(await socket.recv())
        assert info["op"] == "serverInfo", info
        while LATER not in channels or "/tf" not in channels or "/car/map/safe_path" not in channels:
            advertised = json.loads(await socket.recv())
            assert advertised["op"] == "advertise", advertised
            channels.update({channel["topic"]: channel for channel in advertised["channels"]})
        ids = {topic: number for number, topic in enumerate(sorted(channels))}
        decoders = {ids[topic]: decoder(channel) for topic, channel in channels.items()}

        async def subscribe(topic):
            wish = {"id": ids[topic], "channelId": channels[topic]["id"]}
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": [wish]}))

        # One who wants everything and reads nothing is nobody else's trouble.
        stalled = await connect(url, subprotocols=["foxglove.sdk.v1"], max_queue=1)
        wishes = [{"id": ids[topic], "channelId": channel["id"]} for topic, channel in channels.items()]
        await stalled.send(json.dumps({"op": "subscribe", "subscriptions": wishes}))

        # The points' subscription has been heard when what was asked for after it comes.
        now = ["/car/map/drivability", "/car/map/occupancy", "/tf"]
        for topic in [LATER, *now]:
            await subscribe(topic)
        told = await receive(socket, decoders, {ids[topic] for topic in now})
        topics = {topic: channel["schemaName"] for topic, channel in channels.items()}
        print(json.dumps({"name": info["name"], "channels": topics, **{topic: told[ids[topic]] for topic in now}}), flush=True)
        told = await receive(socket, decoders, {ids[LATER]})
        print(json.dumps(told[ids[LATER]]), flush=True)
        stalled.transport.abort()


asyncio.run(asyncio.wait_for(main(sys.argv[1]), 60))

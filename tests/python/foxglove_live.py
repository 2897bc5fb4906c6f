"""A WebSocket client of Foxglove's protocol. It subscribes to advertised channels, and decodes the messages by the
schemas that are advertised with them.

Prints two JSON objects, one a line: first the messages of the current map, then the points of the next map.

Usage: foxglove_live.py URL
"""

import asyncio
import base64
import json
import sys

import message_json
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
    received = {}
    while set(received) < wanted:
        frame = await socket.recv()
        if isinstance(frame, str):
            continue
        assert frame[0] == 1, frame[0]
        subscription = int.from_bytes(frame[1:5], "little")
        log_ns = int.from_bytes(frame[5:13], "little")
        if subscription in wanted:
            message = decoders[subscription](frame[13:])
            received.setdefault(subscription, {"log_ns": log_ns, **message_json.of_protobuf(message)})
    return received


async def main(url):
    async with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        assert socket.subprotocol == "foxglove.sdk.v1"
        channels = {}
        info = json.loads(await socket.recv())
        assert info["op"] == "serverInfo", info
        while LATER not in channels or "/tf" not in channels or "/car/safe_points" not in channels:
            advertised = json.loads(await socket.recv())
            assert advertised["op"] == "advertise", advertised
            channels.update({channel["topic"]: channel for channel in advertised["channels"]})
        ids = {topic: number for number, topic in enumerate(sorted(channels))}
        decoders = {ids[topic]: decoder(channel) for topic, channel in channels.items()}

        async def subscribe(topic):
            subscription = {"id": ids[topic], "channelId": channels[topic]["id"]}
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))

        # A client that subscribes to everything and reads nothing does not disturb the others.
        stalled = await connect(url, subprotocols=["foxglove.sdk.v1"], max_queue=1)
        everything = [{"id": ids[topic], "channelId": channel["id"]} for topic, channel in channels.items()]
        await stalled.send(json.dumps({"op": "subscribe", "subscriptions": everything}))

        # The server reads subscriptions in order: the points are subscribed when messages of later subscriptions come.
        now = ["/car/map/drivability", "/car/map/occupancy", "/car/safe_points", "/car/plan", "/car/log", "/tf"]
        for topic in [LATER, *now]:
            await subscribe(topic)
        received = await receive(socket, decoders, {ids[topic] for topic in now})
        topics = {topic: channel["schemaName"] for topic, channel in channels.items()}
        newest = {topic: received[ids[topic]] for topic in now}
        print(json.dumps({"name": info["name"], "channels": topics, **newest}), flush=True)
        received = await receive(socket, decoders, {ids[LATER]})
        print(json.dumps(received[ids[LATER]]), flush=True)
        stalled.transport.abort()


asyncio.run(asyncio.wait_for(main(sys.argv[1]), 60))

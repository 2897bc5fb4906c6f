"""Reads an MCAP file with the schemas that the file holds, and prints its topics as one JSON object, each with its
schema, its metadata, its number of messages and its last message.

Usage: viewer_file.py FILE
"""

import json
import sys

import message_json
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2


def plain(value):
    """A decoded ROS 2 message as JSON values."""
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes):
        return message_json.of_bytes(value)
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def main(file):
    topics = {}
    with open(file, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[Protobuf(), Ros2()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            known = {"schema": schema.name, "metadata": channel.metadata, "count": 0}
            topic = topics.setdefault(channel.topic, known)
            topic["count"] += 1
            topic["log_ns"] = message.log_time
            topic["last"] = decoded
    for topic in topics.values():
        last = topic["last"]
        topic["last"] = message_json.of_protobuf(last) if hasattr(last, "DESCRIPTOR") else plain(last)
    print(json.dumps(topics))


main(sys.argv[1])

"""Reads an MCAP file with nothing but what the file says of itself; prints its topics with schema, number of messages and the
last message of each, as one JSON object.

Usage: viewer_file.py FILE
"""

import json
import sys

import told
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2


def plain(value):
    """A decoded ROS 2 message as JSON has it."""
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes):
        return told.of_bytes(value)
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def main(file):
    topics = {}
    with open(file, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[Protobuf(), Ros2()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            topic = topics.setdefault(channel.topic, {"schema": schema.name, "count": 0})
            topic["count"] += 1
            topic["log_ns"] = message.log_time
            topic["last"] = decoded
    for topic in topics.values():
        last = topic["last"]
        topic["last"] = told.protobuf(last) if hasattr(last, "DESCRIPTOR") else plain(last)
    print(json.dumps(topics))


main(sys.argv[1])

"""A decoded protobuf message as JSON has it; of long data the length and the CRC-32."""

import zlib

from google.protobuf import json_format


def protobuf(message):
    told = json_format.MessageToDict(message, preserving_proto_field_name=True)
    if "data" in told:
        told["data"] = of_bytes(message.data)
    return told


def of_bytes(data):
    """Their length and CRC-32."""
    return {"length": len(data), "crc32": zlib.crc32(data)}

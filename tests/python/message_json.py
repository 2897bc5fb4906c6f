"""Decoded messages as JSON values; long data are replaced by their length and CRC-32."""

import zlib

from google.protobuf import json_format


def of_protobuf(message):
    """The fields of a protobuf message."""
    fields = json_format.MessageToDict(message, preserving_proto_field_name=True)
    if "data" in fields:
        fields["data"] = of_bytes(message.data)
    return fields


def of_bytes(data):
    """The length and CRC-32 of the data."""
    return {"length": len(data), "crc32": zlib.crc32(data)}

"""The messages of proto/clearway/v1, as the modules `map_pb2`, `service_pb2` and so on, and stubs of its services.

They are made at import, from the descriptors that the build has stored. Code that protoc generates needs a protobuf of
its own major version or the next one; descriptors are read by each. Their pool is this package's own, so that another
copy of the messages in the same process does not matter.
"""

import sys
from importlib.resources import files
from types import ModuleType
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.internal.enum_type_wrapper import EnumTypeWrapper

#: The file beside this one: an encoded `FileDescriptorSet` of every file of proto/clearway/v1.
DESCRIPTORS = "descriptors.binpb"
_pool = descriptor_pool.DescriptorPool()


def _load() -> None:
    stored = descriptor_pb2.FileDescriptorSet.FromString(files(__name__).joinpath(DESCRIPTORS).read_bytes())
    for file in stored.file:
        _pool.AddSerializedFile(file.SerializeToString())
        described = _pool.FindFileByName(file.name)
        name = file.name.removeprefix("clearway/v1/").removesuffix(".proto") + "_pb2"
        module = sys.modules[f"{__name__}.{name}"] = ModuleType(f"{__name__}.{name}")
        globals()[name] = module
        for message in described.message_types_by_name.values():
            setattr(module, message.name, message_factory.GetMessageClass(message))
        for enum in described.enum_types_by_name.values():
            setattr(module, enum.name, EnumTypeWrapper(enum))
            vars(module).update((value.name, value.number) for value in enum.values)


class Stub:
    """The methods of a service, such as "MapService", on a `grpc.Channel` or `grpc.aio.Channel`."""

    def __init__(self, channel: Any, service: str) -> None:
        described = _pool.FindServiceByName(f"clearway.v1.{service}")
        for method in described.methods:
            kind = "_".join("stream" if many else "unary" for many in (method.client_streaming, method.server_streaming))
            reply = message_factory.GetMessageClass(method.output_type)
            request = message_factory.GetMessageClass(method.input_type)
            call = getattr(channel, kind)(
                f"/{described.full_name}/{method.name}", request.SerializeToString, reply.FromString
            )
            setattr(self, method.name, call)

    def __getattr__(self, method: str) -> Any:
        raise AttributeError(f"this service has no method {method!r}")


_load()

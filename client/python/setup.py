"""Compiles the wire contract, proto/clearway/v1, into descriptors and types in clearway/v1 of what is built, and adds
the golden recording.

In a checkout both lie outside this folder, in a source distribution in it: the distribution carries copies. Nothing
generated lies in the tree.
"""

from pathlib import Path
from shutil import copyfile

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).resolve().parent
IS_DISTRIBUTION = (HERE / "PKG-INFO").exists()
PROTO = HERE / "proto" if IS_DISTRIBUTION else HERE.parent.parent / "proto"
GOLDEN = HERE / "golden" if IS_DISTRIBUTION else HERE.parent / "golden"
MESSAGES = sorted(path.relative_to(PROTO).as_posix() for path in (PROTO / "clearway" / "v1").glob("*.proto"))
RECORDING = GOLDEN / "town.mcap"


def copy(source: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    copyfile(source, to)


class BuildWithMessages(build_py):
    """`build_py`, the messages and the golden recording."""

    def run(self) -> None:
        from grpc_tools import protoc

        super().run()
        out = Path(self.build_lib)
        stored = out / "clearway" / "v1" / "descriptors.binpb"
        arguments = ["protoc", f"-I{PROTO}", f"--descriptor_set_out={stored}", f"--pyi_out={out}"]
        if not MESSAGES or protoc.main(arguments + MESSAGES) != 0:
            raise SystemExit(f"no messages could be made of {PROTO}/clearway/v1: build from a whole checkout")
        copy(RECORDING, out / "clearway" / "golden" / RECORDING.name)


class DistributionWithContract(sdist):
    """`sdist`, with the wire contract and the golden recording."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        for message in MESSAGES:
            copy(PROTO / message, Path(base_dir, "proto", message))
        copy(RECORDING, Path(base_dir, "golden", RECORDING.name))


setup(cmdclass={"build_py": BuildWithMessages, "sdist": DistributionWithContract})

"""Compiles the wire contract, ../../proto, into clearway/v1 of what is built; nothing generated lies in the tree."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PROTO = Path(__file__).resolve().parent.parent.parent / "proto"
MESSAGES = sorted(path.relative_to(PROTO).as_posix() for path in (PROTO / "clearway" / "v1").glob("*.proto"))


class BuildWithMessages(build_py):
    """`build_py`, and the generated messages."""

    def run(self) -> None:
        from grpc_tools import protoc

        super().run()
        out = Path(self.build_lib)
        (out / "clearway" / "v1").mkdir(parents=True, exist_ok=True)
        arguments = ["protoc", f"-I{PROTO}", f"--python_out={out}", f"--pyi_out={out}", f"--grpc_python_out={out}"]
        if not MESSAGES or protoc.main(arguments + MESSAGES) != 0:
            raise SystemExit(f"no messages could be made of {PROTO}/clearway/v1: build from a whole checkout")
        (out / "clearway" / "v1" / "__init__.py").write_text('"""The messages of proto/clearway/v1."""\n')


setup(cmdclass={"build_py": BuildWithMessages})

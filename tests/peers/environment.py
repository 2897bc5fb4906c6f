"""The Python environment that a script here runs in."""

import os
import subprocess
import sys
from pathlib import Path


def enter(folder, packages):
    """Runs the script again with an interpreter below `folder` that has the packages, unless this one has them."""
    interpreter = folder / "bin/python"
    if Path(sys.prefix).resolve() == folder.resolve():
        return
    stamp = folder / "installed"
    if not stamp.exists() or stamp.read_text() != "\n".join(packages):
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        subprocess.run([interpreter, "-m", "pip", "install", "--quiet", "--no-input", *packages], check=True)
        stamp.write_text("\n".join(packages))
    os.execv(interpreter, [str(interpreter), "-B", *sys.argv])

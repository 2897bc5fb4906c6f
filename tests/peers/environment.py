"""What the scripts here run in and run: a Python environment with packages, and programs that cargo builds."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]


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


def build(*arguments):
    """Runs cargo with these arguments; returns the paths of the programs that it built, by name."""
    command = ["cargo", *arguments, "--message-format=json"]
    messages = subprocess.run(command, cwd=REPOSITORY, check=True, stdout=subprocess.PIPE, text=True).stdout
    built = [json.loads(line) for line in messages.splitlines()]
    return {message["target"]["name"]: message["executable"] for message in built if message.get("executable")}


def write_csv(file, header, rows):
    with open(file, "w", newline="") as written:
        writer = csv.writer(written)
        writer.writerow(header)
        writer.writerows(rows)

"""The notebook runs from the top, and shows what it should."""

import os
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "maps.ipynb"


@pytest.mark.skipif(not os.environ.get("CLEARWAY"), reason="CLEARWAY names no command")
def test_the_notebook_shows_a_map_a_picture_and_a_grid(tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    kernels = tmp_path / "kernels" / "python3"
    kernels.mkdir(parents=True)
    # The kernel of this interpreter, whatever others are installed.
    argv = f'["{sys.executable}", "-m", "ipykernel_launcher", "-f", "{{connection_file}}"]'
    (kernels / "kernel.json").write_text(f'{{"argv": {argv}, "display_name": "Python 3", "language": "python"}}')
    os.environ["JUPYTER_PATH"] = str(tmp_path)
    notebook = nbformat.read(EXAMPLE, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120).execute()
    shown = [output["data"] for cell in notebook.cells[1:] for output in cell["outputs"] if "data" in output]
    assert shown[0]["text/plain"].startswith("<Map 9 of car") and "image/png" in shown[1]
    assert shown[2]["text/plain"].startswith("(0.25,")

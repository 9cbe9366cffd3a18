"""Make the notebooks from their texts and run them: `python docs/make/notebooks.py`.

The text of each is a script in the percent format, which people and git can read; the notebook with its
outputs is committed beside it, so that the pages are built without running anything.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "notebooks"


def digest(script: Path) -> str:
    """SHA-256 of the text."""
    return hashlib.sha256(script.read_text(encoding="utf-8").encode()).hexdigest()


def cells(text: str) -> list[tuple[str, str]]:
    """Kind and content of the cells of a script in the percent format."""
    found = []
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if "[markdown]" in head:
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip().split("\n")]
            found.append(("markdown", "\n".join(lines)))
        else:
            found.append(("code", body.strip()))
    return found


def make(script: Path) -> None:
    """Write and run one notebook."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.v4.new_notebook()
    notebook.metadata["made_from"] = {"script": script.name, "sha256": digest(script)}
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    for number, (kind, content) in enumerate(cells(script.read_text(encoding="utf-8"))):
        cell = getattr(nbformat.v4, f"new_{kind}_cell")(content)
        cell["id"] = f"cell-{number}"
        notebook.cells.append(cell)
    with tempfile.TemporaryDirectory() as empty:
        NotebookClient(
            notebook, timeout=300, resources={"metadata": {"path": empty}}, record_timing=False
        ).execute()
    for output in (one for cell in notebook.cells for one in cell.get("outputs", [])):
        if "text/html" in (shown := output.get("data", {})):
            shown["text/plain"] = ""  # the whole object as text, which nobody sees
    nbformat.write(notebook, script.with_suffix(".ipynb"))


if __name__ == "__main__":
    os.environ["PYTHONPATH"] = str(FOLDER.parents[1])
    for each in sorted(FOLDER.glob("*.py")):
        print(each.stem, flush=True)
        make(each)

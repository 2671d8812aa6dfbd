"""Execute the notebooks in place of their readers: an exception in any cell fails.

Usage: python notebooks/execute.py [--write]; with --write the outputs are stored in the files.
"""

import argparse
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def main() -> None:
    """Run every notebook of this folder in its own kernel."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--write", action="store_true", help="store the outputs in the files")
    write = parser.parse_args().write
    folder = Path(__file__).parent
    for path in sorted(folder.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        resources = {"metadata": {"path": str(folder)}}
        NotebookClient(notebook, timeout=900, kernel_name="python3", resources=resources).execute()
        print(f"{path.name}: {len(notebook.cells)} cells ran")
        if write:
            nbformat.write(notebook, path)


if __name__ == "__main__":
    main()

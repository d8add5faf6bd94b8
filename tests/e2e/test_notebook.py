"""The explorer in a notebook: the page stands in the cell, and its server ends with the kernel."""

from __future__ import annotations

import http.server
import re
import threading
import urllib.error
import urllib.request
from functools import partial
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.e2e.conftest import PATIENCE, Contexts

nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel, of the extra dev")
pytest.importorskip("ipykernel", reason="needs nbclient and ipykernel, of the extra dev")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]


@pytest.mark.slow
def test_a_notebook_shows_the_page_in_a_cell_and_ends_it_with_its_kernel(
    data: Path, model_file: Path, tmp_path: Path, contexts: Contexts
) -> None:
    import nbformat

    cells = [
        f"import lpn\npage = lpn.explore({str(model_file)!r}, {str(data)!r})\npage",
        f"with lpn.explore({str(model_file)!r}, {str(data)!r}) as other:\n    print(other.url)",
        "[page.url, other.closed, other]",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    client = nbclient.NotebookClient(
        notebook, timeout=int(5 * PATIENCE), resources={"metadata": {"path": str(tmp_path)}}
    )
    with client.setup_kernel():
        for index, cell in enumerate(notebook.cells):
            client.execute_cell(cell, index)
        bundle = next(one for one in notebook.cells[0].outputs if one.output_type == "execute_result").data
        url = re.search(r'<iframe src="(http://127\.0\.0\.1:\d+)"', bundle["text/html"])
        assert bundle["text/plain"] == f"<LPN Explorer at {url[1]}>"
        outputs = [one for cell in notebook.cells for one in cell.outputs]
        assert not [one for one in outputs if one.output_type == "display_data" or "viser" in one.get("text", "")]
        printed = notebook.cells[1].outputs[-1].text.split()[-1]
        assert notebook.cells[2].outputs[0].data["text/plain"] == f"['{url[1]}', True, <LPN Explorer closed>]"
        assert not answers(printed)
        show(bundle["text/html"], tmp_path, contexts)
    assert not answers(url[1])


def show(html: str, folder: Path, contexts: Contexts) -> None:
    """Show the output of a cell in a page of another server of this machine, as a notebook does."""
    (folder / "cell.html").write_text(f"<!doctype html><title>notebook</title>{html}")
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = contexts().new_page()
        page.goto(f"http://localhost:{server.server_port}/cell.html")
        expect(page.frame_locator("iframe").locator("#strip .tile").first).to_be_visible()
        page.close()
        server.shutdown()


def answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE) as response:
            return int(response.status) == 200
    except urllib.error.URLError as error:
        if not isinstance(error.reason, ConnectionRefusedError):
            raise
        return False

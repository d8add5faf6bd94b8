"""The page behind proxies: it opens, or names the headers and requests that they must pass."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import expect

from tests.e2e.conftest import PATIENCE, NewPage, RunningApp
from tools.fixtures.processes import free_ports
from tools.fixtures.small_proxy import SmallProxy

SERVING = Path(__file__).parents[2] / "docs" / "serving.md"


def port(app: RunningApp) -> int:
    return urlsplit(app.url).port or 0


LOST = "Connection lost. Trying again."


def test_a_page_whose_websockets_do_not_arrive_says_so_and_goes_on_once_they_do(
    app: RunningApp, new_page: NewPage
) -> None:
    with SmallProxy(port(app), drop=("upgrade",)) as proxy:
        page = new_page()
        page.goto(proxy.url)
        expect(page.locator("#headline h1")).to_have_text(LOST)
        proxy.drop = ()
        expect(page.locator("#strip .tile").first).to_be_visible()
        expect(page.locator("#headline h1")).not_to_have_text(LOST)


def test_the_page_opens_below_a_folder(app: RunningApp, new_page: NewPage) -> None:
    with SmallProxy(port(app), folder="maps", strip=False) as proxy:
        page = new_page()
        page.goto(proxy.url)
        expect(page.locator("#strip .tile").first).to_be_visible()
        page.keyboard.press("n")
        expect(page).to_have_url(re.compile(r"/maps/\?query="))


def blocks(start: str) -> list[str]:
    """The configurations of docs/serving.md whose first line begins so."""
    found = re.findall(r"(?:^    .*\n|^\n(?=    ))+", SERVING.read_text("utf-8"), re.MULTILINE)
    return [block for block in found if block.strip().startswith(start)]


@contextmanager
def running(*command: str) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(60)


def opens(new_page: NewPage, address: str) -> None:
    """Check that the page opens; the proxy may still be starting."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", urlsplit(address).port or 0)) == 0:
                break
        time.sleep(0.05)
    page = new_page()
    page.goto(address)
    expect(page.locator("#strip .tile").first).to_be_visible()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed")
def test_the_documented_blocks_of_nginx_work(app: RunningApp, new_page: NewPage, tmp_path: Path) -> None:
    (own,), (below,) = blocks("server {"), blocks("location /maps/ {")
    whole, folder = free_ports(2)
    own = re.sub(r"^ *(ssl_|auth_|server_name).*\n", "", own, flags=re.MULTILINE).replace(
        "443 ssl", f"127.0.0.1:{whole}"
    )
    paths = "".join(f"{kind}_temp_path {tmp_path};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi"))
    text = f"pid {tmp_path}/pid; error_log {tmp_path}/errors; daemon off; events {{}} http {{ access_log off; {paths}\n{own}"
    text += f"server {{ listen 127.0.0.1:{folder};\n{below} }} }}"
    (tmp_path / "nginx.conf").write_text(text.replace("127.0.0.1:8080", f"127.0.0.1:{port(app)}"))
    with running("nginx", "-e", str(tmp_path / "errors"), "-c", str(tmp_path / "nginx.conf")):
        opens(new_page, f"http://127.0.0.1:{whole}/")
        opens(new_page, f"http://127.0.0.1:{folder}/maps/")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("caddy") is None, reason="Caddy is not installed")
def test_the_documented_blocks_of_caddy_work(app: RunningApp, new_page: NewPage, tmp_path: Path) -> None:
    (own,), (below,) = blocks("maps.example.org {"), blocks("tools.example.org {")
    whole, folder = free_ports(2)
    own = re.sub(r"basicauth \{.*?\}\n", "", own, flags=re.DOTALL).replace("maps.example.org", f":{whole}")
    text = "{\n admin off\n auto_https off\n}\n" + own + below.replace("tools.example.org", f":{folder}")
    (tmp_path / "Caddyfile").write_text(text.replace("127.0.0.1:8080", f"127.0.0.1:{port(app)}"))
    with running("caddy", "run", "--adapter", "caddyfile", "--config", str(tmp_path / "Caddyfile")):
        opens(new_page, f"http://127.0.0.1:{whole}/")
        opens(new_page, f"http://127.0.0.1:{folder}/maps/")

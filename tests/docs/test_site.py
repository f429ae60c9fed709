"""The built documentation site, in a browser."""

import shutil
import subprocess
import sys
import threading
from collections import defaultdict
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlsplit

import pytest
from playwright.sync_api import sync_playwright

from tests.docs.pages import PAGES, ROOT

pytestmark = pytest.mark.long

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
QUIET = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
LARGEST_PAGE = 2 * 10**6  # bytes


class SilentHandler(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture(scope="module")
def site():
    """Folder of the built pages."""
    command = [Path(sys.executable).with_name("zensical"), "build", "--clean", "--strict"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return ROOT / "outputs" / "site"


@pytest.fixture(scope="module")
def address(site):
    """Address of a local server of the pages."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SilentHandler, directory=site)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def tab():
    """A page of a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)  # None uses Playwright's own
    with sync_playwright() as play:
        window = play.chromium.launch(executable_path=browser, args=QUIET)
        yield window.new_page()
        window.close()


def test_site_has_every_page_and_public_name(site):
    assert {page.stem for page in PAGES} <= {file.stem for file in site.glob("*.html")}
    reference = (site / "reference.html").read_text()
    for name in (
        "views.make_view",
        "geometry.camera.project",
        "geometry.zbuffer.zbuffer_from_points",
        "views.reproject",
        "views.ReprojectedView.infill",
    ):
        assert f'id="lerobot_symview.{name}"' in reference, name


def test_every_page_loads_without_errors(site, address, tab):
    errors, targets, pending = [], defaultdict(set), set()
    tab.on("request", lambda request: pending.add(request))
    for end in ("requestfinished", "requestfailed"):
        tab.on(end, lambda request: pending.discard(request))
    tab.on("console", lambda message: message.type in ("error", "warning") and errors.append(message.text))
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("requestfailed", lambda request: errors.append(f"{request.url} failed"))
    tab.on(
        "request", lambda request: request.url.startswith(address) or errors.append(f"{request.url} is not on the site")
    )
    tab.on("response", lambda response: response.status < 400 or errors.append(f"{response.url}: {response.status}"))
    pages = sorted(file.name for file in site.glob("*.html") if file.name != "404.html")
    for page in pages:
        tab.goto(f"{address}/{page}", wait_until="networkidle")
        tab.evaluate("new Promise(done => requestIdleCallback(done))")  # a slow script may ask for more
        while pending:
            tab.wait_for_timeout(20)
        assert errors == [], page
        assert tab.locator("h1").count() == 1, page
        assert (site / page).stat().st_size < LARGEST_PAGE, page
        assert tab.evaluate("[...document.images].filter(image => !image.naturalWidth).map(image => image.src)") == []
        for link in tab.evaluate("[...document.links].map(link => link.href)"):
            if link.startswith(address):
                target, anchor = urldefrag(link)
                targets[unquote(urlsplit(target).path)].add(unquote(anchor))
    for path, anchors in targets.items():
        file = site / path.removeprefix("/") if path != "/" else site / "index.html"
        assert file.is_file(), path
        text = file.read_text() if file.suffix == ".html" else ""
        assert [anchor for anchor in anchors - {""} if f'id="{anchor}"' not in text] == [], path


def test_search_finds_a_function(address, tab):
    tab.goto(f"{address}/index.html", wait_until="networkidle")
    tab.keyboard.press("/")
    tab.keyboard.type("homography")
    tab.get_by_text("image_from_topdown").first.wait_for(timeout=10_000)

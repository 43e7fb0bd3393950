"""The documentation's site, built as `make docs` does: its links, what it loads, its size, its search."""

import functools
import http.server
import re
import subprocess
import sys
import threading
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from printed import PAGES, ROOT

from lerobot_constructskill.contract import SHIPPED

pytest.importorskip("material", reason="the extra `docs` builds the site")
pytestmark = pytest.mark.slow

LARGEST = 16e6
"""Bytes of the whole site."""

LOADING = {"link", "script", "img", "video", "source", "iframe"}
"""Elements that a browser fetches without being asked."""


OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


class Reader(HTMLParser):
    """What a page refers to, as (element, address), and what can be referred to in it."""

    def __init__(self, page: Path):
        super().__init__()
        self.references, self.anchors = [], {""}
        self.feed(page.read_text())

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.references += [(tag, attributes[name]) for name in ("href", "src") if attributes.get(name)]
        self.anchors |= {attributes[name] for name in ("id", "name") if attributes.get(name)}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", f"--site-dir={folder}"]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def read(site) -> dict[Path, Reader]:
    return {page: Reader(page) for page in site.rglob("*.html")}


def test_every_link_leads_somewhere(site, read):
    dead = [
        f"{page.relative_to(site)}: {address}"
        for page, reader in read.items()
        for _, address in reader.references
        if not urlsplit(address).scheme and not leads(site, read, page, address)
    ]
    assert not dead


def leads(site: Path, read: dict[Path, Reader], page: Path, address: str) -> bool:
    path, anchor = (unquote(part) for part in (urlsplit(address).path, urlsplit(address).fragment))
    target = (site / path[1:] if path.startswith("/") else page.parent / path).resolve() if path else page
    target = target / "index.html" if target.is_dir() else target
    return target.is_file() and (target not in read or anchor in read[target].anchors)


def test_no_page_loads_from_another_host(read):
    foreign = [
        (page.name, address)
        for page, reader in read.items()
        for tag, address in reader.references
        if tag in LOADING and urlsplit(address).netloc
    ]
    assert not foreign


def test_the_site_is_small(site):
    assert sum(file.stat().st_size for file in site.rglob("*") if file.is_file()) < LARGEST


def test_every_chapter_and_task_has_its_page(site):
    chapters = [site / page.relative_to(ROOT).with_suffix(".html") for page in PAGES[1:]]
    tasks = [site / "docs" / "tasks" / f"{task}.html" for task in SHIPPED]
    assert not [page for page in [site / "index.html", *chapters, *tasks] if not page.is_file()]


@pytest.fixture(scope="module")
def server(site):
    handler = functools.partial(Handler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


class Handler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.mark.nightly
@pytest.mark.parametrize("opened", ["server", "file"])
def test_in_a_browser_the_search_finds_a_task_and_nothing_foreign_is_asked(opened, site, server, browser):
    from playwright.sync_api import expect

    home = server if opened == "server" else f"{site.as_uri()}/"
    page = browser.new_page(viewport={"width": 390, "height": 844})
    asked, said = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    for name in ("docs/tasks.html", "docs/tasks/brick_on_brick.html", "site/commands.html", "index.html"):
        page.goto(home + name)
        assert page.evaluate(OVERFLOW) == 0, name
    page.click("header label[for=__search]")
    page.keyboard.type("brick_on_brick")
    found = page.locator(".md-search-result__item a").first  # results of `brick` stand there for a moment
    expect(found).to_have_attribute("href", re.compile(r"docs/tasks/brick_on_brick\.html"))
    assert said == []
    assert [url for url in asked if not url.startswith((home, "data:", "about:"))] == []
    page.close()

"""The documentation site: it is built without a warning, and every link and picture on it leads somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import pytest
from browser import NO_GRAPHICS, launcher
from pages import Page

from ctr_nlp.cli.main import COMMANDS, load

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Request

ROOT = Path(__file__).resolve().parents[1]


class Links(HTMLParser):
    """Where a page leads to, and the places on it that can be led to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets, self.anchors = set[str](), {""}
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := given.get(name))}
        self.targets |= {value for name in ("href", "src") if (value := given.get(name))}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module, reason='needs the site\'s programs: pip install -e ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        check=True,
    )
    return folder


def test_every_link_of_the_site_leads_somewhere(site: Path) -> None:
    pages = {page: Links(page) for page in site.rglob("*.html") if page.name != "404.html"}
    assert len(pages) > 50
    dead = []
    for page, links in pages.items():
        for target in links.targets:
            url = urlsplit(target)
            if url.scheme or url.netloc:
                continue
            place = (page.parent / unquote(url.path)).resolve() if url.path else page
            if not place.exists() or (place in pages and unquote(url.fragment) not in pages[place].anchors):
                dead.append(f"{page.relative_to(site)}: {target}")
    assert dead == []


def test_formulas_are_drawn_without_a_script(site: Path) -> None:
    page = Page.read(ROOT / "docs" / "method.md")
    dollars = sum(re.sub(r"`[^`]*`", "", line).count("$") for line in page.prose)
    displayed = sum(block.language == "math" for block in page.blocks)
    text = (site / "method.html").read_text(encoding="utf-8")
    assert text.count("<math") == dollars // 2 + displayed > 100
    assert "$" not in re.sub(r"<code.*?</code>", "", text, flags=re.DOTALL)


@pytest.mark.parametrize("name", ["Plan", "Robot", "solve_horizon", "Steerer"])
def test_public_names_have_a_page(site: Path, name: str) -> None:
    assert any(f'.{name}"' in page.read_text(encoding="utf-8") for page in (site / "api").glob("*.html"))


def test_pictures_of_concepts_are_drawn_by_their_script_and_shown(tmp_path):
    subprocess.run([sys.executable, "scripts/site/concepts.py", str(tmp_path)], cwd=ROOT, check=True)
    drawn, kept = (
        {path.name for path in folder.glob("*.png")} for folder in (tmp_path, ROOT / "docs" / "concepts")
    )
    assert drawn == kept
    text = "".join(path.read_text() for path in (ROOT / "docs" / "concepts").glob("*.md"))
    assert [name for name in sorted(drawn) if f"]({name})" not in text] == []


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Yield the address of a server of a folder, on loopback."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(folder))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def troubles(site: Path, pages: list[str], widths: tuple[int, ...]) -> list[str]:
    """What Chromium and axe-core find wrong with pages: overflow, script errors, requests to others, findings."""
    axe_playwright = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-core")
    found = list[str]()

    def note(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            found.append(message.text)

    with launcher() as launch, served(site) as home:

        def note_foreign(request: Request) -> None:
            if not request.url.startswith(home):
                found.append(request.url)

        browser = launch(NO_GRAPHICS)
        page = browser.new_page()
        page.on("console", note)
        page.on("pageerror", lambda error: found.append(str(error)))
        page.on("request", note_foreign)
        for width in widths:
            page.set_viewport_size({"width": width, "height": 900})
            for name in pages:
                page.goto(f"{home}/{name}")
                page.wait_for_function("document.querySelector('.md-search')?.hasAttribute('aria-label')")
                beyond = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
                found += [f"{name} is {beyond} px wider than {width}"] * (beyond > 0)
                violations = axe_playwright.Axe().run(page).response["violations"]
                found += [f"{name} at {width}: {each['id']} {each['nodes'][0]['html']}" for each in violations]
        browser.close()
    return found


def test_pages_fit_a_phone_ask_no_other_server_and_have_no_axe_findings(site: Path) -> None:
    assert troubles(site, ["index.html", "method.html", "commands/plan.html"], (390,)) == []


@pytest.mark.slow
def test_every_page_fits_every_screen_and_has_no_axe_findings(site: Path) -> None:
    pages = [str(page.relative_to(site)) for page in site.rglob("*.html") if page.name != "404.html"]
    assert troubles(site, sorted(pages), (390, 768, 1440)) == []


def test_inline_formulas_stay_within_their_sentences(site: Path) -> None:
    text = (site / "method.html").read_text(encoding="utf-8")
    assert re.findall(r"</p>\s*<math", text) == []


def test_every_command_has_a_page_that_lists_its_options(site: Path) -> None:
    for name, entry in COMMANDS.items():
        text = (site / "commands" / f"{name}.html").read_text(encoding="utf-8")
        options = load(entry).parser(name)._option_string_actions
        assert [option for option in options if option.startswith("--") and option not in text] == []

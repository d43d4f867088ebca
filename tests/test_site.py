"""The documentation site: it is built without a warning, and every link and picture on it leads somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from pages import Page

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

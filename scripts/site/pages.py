"""What MkDocs makes of the pages of docs/, which are written so that GitHub shows them as they are.

README.md becomes the first page, and a notebook a page with what it shows. Formulas become MathML, which browsers
draw without a script. A link to another file leads to a page which shows that file. The pages of the Python
interface are made from docstrings; commands.py makes those of the commands from their parsers.
"""

from __future__ import annotations

import importlib
import inspect
import json
import posixpath
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import ctr_nlp

ROOT = Path(__file__).parents[2]
ADDRESSES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
"""Pages that stand beside docs/ -> where they are on the site."""
LANGUAGES = {".py": "python", ".toml": "toml", ".json": "json"}
PARTS = re.compile(
    r"^```(?P<language>\w*)\n(?P<block>.*?)^```$"
    r"|(?P<code>`[^`\n]+`)"
    r"|\$(?P<formula>[^$]+)\$"
    r"|\]\((?!https?:|#)(?P<link>[^()#\s]+)(?P<anchor>#[^()\s]*)?\)",
    re.MULTILINE | re.DOTALL,
)
"""What a page is searched for, in this order: nothing is looked for within code."""
EMPTY_HEADING = re.compile(r"<th([^>]*)>\s*</th>")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages of the interface to the contents."""
    assert config.nav is not None
    config.nav.insert(-1, {"Python": [{Path(address).stem.capitalize(): address} for address in _interface()]})
    config.extra_css.append("site.css")
    config.extra_javascript.append("site.js")
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages whose text is not in docs/: those beside it, the interface, and files that pages link to."""
    pages = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    pages |= {path: (ROOT / path).read_text(encoding="utf-8") for path in ADDRESSES}
    linked = {target for path, text in pages.items() for target in _targets(path, text)}
    for target in sorted(linked - pages.keys()):
        if not target.startswith("docs/"):
            files.append(File.generated(config, _address(target), content=_shown(target)))
    for path in ADDRESSES:
        files.append(File.generated(config, _address(path), content=pages[path]))
    for address, text in _interface().items():
        files.append(File.generated(config, address, content=text))
    for name in ("site.css", "site.js"):
        files.append(File.generated(config, name, abs_src_path=str(Path(__file__).with_name(name))))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as MathML, and links to where their targets are on this site."""
    address = page.file.src_uri
    path = next((path for path, other in ADDRESSES.items() if other == address), f"docs/{address}")

    def part(found: re.Match[str]) -> str:
        if found["language"] == "math":
            return f'<div class="formula">{convert(found["block"].strip(), display="block")}</div>'
        if found["formula"]:
            # Markdown takes a line that begins with <math> for a block of its own, and breaks the sentence there.
            return f"<span>{convert(' '.join(found['formula'].split()))}</span>"
        if found["link"]:
            target = _address(_from_root(path, found["link"]))
            return f"]({posixpath.relpath(target, posixpath.dirname(address) or '.')}{found['anchor'] or ''})"
        return found[0]

    return PARTS.sub(part, markdown) if (ROOT / path).is_file() else markdown


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Empty corners of tables as plain cells: a heading without words is none for a screen reader."""
    return EMPTY_HEADING.sub(r"<td\1></td>", html)


def _targets(path: str, text: str) -> set[str]:
    """The files that a page links to, from the root of the repository."""
    return {_from_root(path, found["link"]) for found in PARTS.finditer(text) if found["link"]}


def _from_root(path: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), link))


def _address(path: str) -> str:
    """Where a file of the repository is on the site; path from its root."""
    if path in ADDRESSES:
        return ADDRESSES[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else f"source/{path}.md"


def _shown(path: str) -> str:
    """A page that shows a file, or names the files of a folder."""
    place = ROOT / path
    if place.is_dir():
        names = sorted(item.name for item in place.iterdir() if not item.name.startswith(("_", ".")))
        text = "\n".join(f"- `{name}`" for name in names)
    elif place.suffix == ".ipynb":
        return "\n\n".join(map(_cell, json.loads(place.read_text(encoding="utf-8"))["cells"]))
    else:
        text = f"````{LANGUAGES.get(place.suffix, 'text')}\n{place.read_text(encoding='utf-8')}\n````"
    return f"---\nsearch:\n  exclude: true\n---\n# {path}\n\n{text}\n"


def _cell(cell: dict[str, Any]) -> str:
    """A cell of a notebook, with what it shows."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return source
    parts = [f"```python\n{source}\n```"]
    for output in cell["outputs"]:
        shown = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in shown:
            parts.append(
                f'<img alt="What the cell shows" src="data:image/png;base64,{"".join(shown["image/png"])}">'
            )
        elif "text/html" in shown:
            parts.append(f"<div>{''.join(shown['text/html'])}</div>")
        else:
            parts.append(f"```text\n{''.join(shown['text/plain']).rstrip()}\n```")
    return "\n\n".join(parts)


def _interface() -> dict[str, str]:
    """Address -> text of the pages of the interface: one for each room with names that `import ctr_nlp` gives."""
    rooms = defaultdict(list)
    for name in set(ctr_nlp.__all__) - {"__version__"}:
        module = getattr(ctr_nlp, name).__module__
        rooms[module.split(".")[1]].append(f"::: {module}.{name}")
    return {f"api/{room}.md": _page(room, sorted(names)) for room, names in sorted(rooms.items())}


def _page(room: str, names: list[str]) -> str:
    about = inspect.getdoc(importlib.import_module(f"ctr_nlp.{room}")) or ""
    return "\n\n".join([f"# ctr_nlp.{room}", about, *names]) + "\n"

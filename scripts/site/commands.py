"""Reference pages of the commands, made from their parsers: what `ctr-nlp COMMAND --help` says, as tables."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import cache

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from ctr_nlp.cli import main as cli
from ctr_nlp.cli.console import examples

WIDTH = 72
"""Characters of a line in a usage message."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages of the commands to the contents."""
    assert config.nav is not None
    config.nav.insert(-1, {"Commands": list(command_pages())})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the texts of these pages."""
    for address, text in command_pages().items():
        files.append(File.generated(config, address, content=text))
    return files


@cache
def command_pages() -> dict[str, str]:
    """Make the reference pages, Markdown text by address: an overview, and a page for each command."""
    overview = [
        "# Commands",
        "Every command is `ctr-nlp COMMAND`. `ctr-nlp COMMAND --help` prints what these pages say.",
        "| command | what it does |\n|---|---|\n"
        + "\n".join(f"| [`{name}`]({name}.md) | {_cell(entry.summary)} |" for name, entry in cli.COMMANDS.items()),
        "Exit status: 0 where all is well, 1 where something is not (a verdict is `no`, say), 2 where input is "
        "bad and nothing is written, 130 after an interruption.",
    ]
    pages = {"commands/index.md": "\n\n".join(overview) + "\n"}
    for name, entry in cli.COMMANDS.items():
        parser = cli.load(entry).parser(f"ctr-nlp {name}")
        pages[f"commands/{name}.md"] = "\n\n".join(_page(name, entry.summary, parser)) + "\n"
    return pages


def _page(name: str, summary: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the paragraphs of a command's page."""
    yield f"# ctr-nlp {name}"
    yield parser.description or f"{summary[0].upper()}{summary[1:]}."
    parser.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=WIDTH)
    yield f"```text\n{parser.format_usage().strip()}\n```"
    given = examples(name)
    if given:
        yield "## Examples"
        yield "\n\n".join(f"{what}\n\n```bash\n{f'ctr-nlp {name} {call}'.rstrip()}\n```" for what, call in given)
    # argparse has no public way to its groups.
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.help != argparse.SUPPRESS]
        if actions:
            yield f"## {(group.title or 'options').capitalize()}"
            if group.description:
                yield group.description
            yield "| option | what it does |\n|---|---|\n" + "\n".join(map(_row, actions))


def _row(action: argparse.Action) -> str:
    """Return the table row of an option or argument: how it is written, and what it does."""
    formatter = argparse.HelpFormatter("", width=WIDTH)
    written = formatter._format_action_invocation(action)
    return f"| `{_cell(written)}` | {_cell(formatter._expand_help(action)) if action.help else ''} |"


def _cell(text: str) -> str:
    """Return a text as a cell of a table."""
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())

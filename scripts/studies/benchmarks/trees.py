"""Temporary checkout of another commit of this repository."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ctr_nlp.exceptions import BenchmarkError

ROOT = Path(__file__).resolve().parents[3]
"""The tree of which this file is a part."""


@contextmanager
def tree_of(commit: str) -> Iterator[Path]:
    """Yield a work tree of a commit in a temporary folder, which is removed afterwards; raises BenchmarkError."""
    # --end-of-options: a commit that begins with a dash is not taken for an option of git.
    name = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}", of=commit)
    with tempfile.TemporaryDirectory(prefix="ctr_nlp-") as folder:
        tree = Path(folder) / "tree"
        _git("worktree", "add", "--detach", "--quiet", str(tree), name, of=commit)
        try:
            yield tree
        finally:
            _git("worktree", "remove", "--force", str(tree), of=commit)


def _git(*arguments: str, of: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        told = (getattr(error, "stderr", "") or "").strip() or str(error)
        raise BenchmarkError(f"commit {of!r} of {ROOT} cannot be checked out: {told}") from error
    return done.stdout.strip()

"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from pathlib import Path

import casadi as ca

from ctr_nlp.errors import OptionError
from ctr_nlp.nlp import FrameFunctions

FLAGS = ("-O1", "-fPIC", "-shared")
"""Higher levels take three times as long to compile and gain a tenth."""


def compiled(functions: FrameFunctions, folder: Path) -> FrameFunctions:
    """The same functions from a library in folder, which must outlive them; raises OptionError.

    A library that is there already for the same code is taken.
    """
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise OptionError("no C compiler was found; install gcc or clang")
    generator = ca.CodeGenerator("frame.c")
    for function in functions:
        generator.add(function)
    code = generator.dump()
    source = folder / f"frame-{hashlib.sha256(code.encode()).hexdigest()[:16]}.c"
    library = source.with_suffix(".so")
    if not library.exists():
        source.write_text(code, encoding="utf-8")
        subprocess.run([compiler, *FLAGS, "-o", library, source, "-lm"], check=True)
    return FrameFunctions(*(ca.external(function.name(), str(library)) for function in functions))

"""CUDA C++ to PTX, the instructions of NVIDIA's graphics cards, by NVRTC: a library that needs no card.

PTX is text for a whole family of cards; a card's driver translates it when a program is loaded.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.extras import import_extra

DEFAULT_CARD_ARCHITECTURE = "compute_90"
"""Family of cards that PTX is made for by default: H100 and H200."""
_HEADER_NAMES = b"math.h", b"stdlib.h", b"string.h"
"""Headers that C needs and CUDA does not have: empty, as CUDA knows their functions without any."""
_OPTIONS = "-default-device", "--std=c++17", "-w"
"""Options for NVRTC: functions without a marker run on the card; no warnings, as of pragmas of other compilers."""


def build_ptx(source: str, architecture: str = DEFAULT_CARD_ARCHITECTURE) -> str:
    """Return the PTX of a text in CUDA C++ for a family of cards.

    Raises OptionError where NVRTC is not installed, and where it refuses the text.
    """
    library = _load_nvrtc()
    program = ctypes.c_void_p()
    headers = (ctypes.c_char_p * len(_HEADER_NAMES))(*[b""] * len(_HEADER_NAMES))
    names = (ctypes.c_char_p * len(_HEADER_NAMES))(*_HEADER_NAMES)
    library.nvrtcCreateProgram(
        ctypes.byref(program), source.encode(), b"source.cu", len(_HEADER_NAMES), headers, names
    )
    try:
        options = [option.encode() for option in (f"--gpu-architecture={architecture}", *_OPTIONS)]
        failed = library.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
        if failed:
            said = _read_text(library, program, "ProgramLog").strip()
            raise OptionError(f"NVRTC cannot compile for {architecture}: {said[:500] or failed}")
        return _read_text(library, program, "PTX")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _load_nvrtc() -> ctypes.CDLL:
    """Load NVRTC from its package; raises OptionError where it is missing."""
    folder = Path(*import_extra("nvidia.cuda_nvrtc").__path__)
    libraries = sorted(folder.glob("lib/libnvrtc*.so.*")) + sorted(folder.glob("bin/nvrtc64*.dll"))
    found = [path for path in libraries if ".alt" not in path.name and "builtins" not in path.name]
    if not found:
        raise OptionError(f"{folder} has no library of NVRTC; install the extra gpu again")
    return ctypes.CDLL(str(found[0]))


def _read_text(library: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> str:
    """Return a text of a program, by the pair of functions nvrtcGet<what>Size and nvrtcGet<what>."""
    size = ctypes.c_size_t()
    library[f"nvrtcGet{what}Size"](program, ctypes.byref(size))
    text = ctypes.create_string_buffer(size.value)
    library[f"nvrtcGet{what}"](program, text)
    return text.value.decode(errors="replace")

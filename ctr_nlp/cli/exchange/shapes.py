"""`ctr-nlp export --to slicer|gltf|mat|shapes-csv`: write the shapes of a plan for other programs."""

from __future__ import annotations

from pathlib import Path

from ctr_nlp.cli.output.file import check_file, write_bytes, write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import console, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.exchange.formats import FILE_FORMATS, SLICER_FORMAT
from ctr_nlp.view.exchange.slicer import slicer_files


def write_shapes(source: Path, to: str, out: Path | None, space: str | None) -> None:
    """Write a plan in the format of another program, and report where; raises CtrError.

    source: file of the plan. to: one of EXCHANGE_FORMATS. out: file or folder to write, None for one beside the
    plan. space: patient coordinates of the path's file, LPS or RAS, where that does not state them; for Slicer
    alone.
    """
    if to == SLICER_FORMAT:
        _write_folder(source, out or source.with_name(f"{source.stem}_slicer"), space)
        return
    format = FILE_FORMATS[to]
    out = out or source.with_name(source.stem + format.suffix)
    check_file(out, format.signature, format.signature_offset)
    content = format.encode(Plan.load(source))
    write_bytes(out, content)
    report_written_files(out, more=f" ({len(content) / 1e6:.1f} MB)")


def _write_folder(source: Path, out: Path, space: str | None) -> None:
    if out.suffix in (".json", ".vtp", ".py"):
        raise OptionError(f"--out is {out}, but --to {SLICER_FORMAT} writes a folder of files; name a folder")
    check_folder(out, "slicer")
    files = slicer_files(Plan.load(source), space)
    with output_folder(out, "slicer") as staging:
        for name, text in files.items():
            write_text(staging / name, text)
    report_written_files(
        out, more=f": {len(files)} files in LPS coordinates, in mm. In the Python console of 3D Slicer:"
    )
    brought = f"import sys; sys.path.insert(0, {str(out.absolute())!r}); import load_in_slicer as plan"
    console().print(f"{brought}; browser = plan.load()", soft_wrap=True)

"""`ctr-nlp new`: write a commented problem, robot, hardware, load or study file to start from."""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.output.file import check_file, write_text
from ctr_nlp.cli.terminal_output import report_written_files
from ctr_nlp.exceptions import OptionError, OutputError

NEXT_COMMAND_BY_TEMPLATE = {
    "problem.py": "ctr-nlp plan {file}",
    "robot.toml": "ctr-nlp plan bronchus --robot {file}",
    "hardware.toml": "ctr-nlp play PLAN.npz --hardware {file} --dry-run",
    "load.toml": "ctr-nlp under PLAN.npz --load {file}",
    "study.toml": "ctr-nlp study {file}",
    "survival.toml": "ctr-nlp study {file}",
}
"""Command to try next with a copy of each template."""
TEMPLATE_BY_KIND = {Path(name).stem: name for name in NEXT_COMMAND_BY_TEMPLATE}


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Write a file with comments to start from: a problem (.py), a robot, its hardware, a load "
        "or a study of many plans (.toml). `survival` is a study that ends with a page on how plans "
        "survive robots that are not quite known. A robot may come from a file of another program, too.",
        epilog="Exit status: 0 where the file was written, 2 where input is bad and nothing is written. A file "
        "that is there is never replaced.",
    )
    parser.add_argument("kind", choices=TEMPLATE_BY_KIND)
    parser.add_argument("file", metavar="FILE", help="to write; its name ends in .py or .toml")
    peers = parser.add_argument_group("a robot of another program")
    what = "tubes in SI units, as MexLib (OD, ID, k, L, Lt, E, G) or gym-ctr (length, length_curved, ..) have them"
    peers.add_argument("--from", metavar="TUBES.json|TUBES.mat", dest="source", help=what)
    peers.add_argument("--name", help="which robot, where that file holds several")
    what = "of every tube, in place of what Young's and shear modulus give, e.g. 0.3"
    peers.add_argument("--poisson-ratio", metavar="NU", type=float, help=what)
    return parser


def template(name: str) -> str:
    """Return the text of the template called `name`, a key of NEXT_COMMAND_BY_TEMPLATE."""
    return files("ctr_nlp.cli").joinpath("templates", name).read_text(encoding="utf-8")


def _text(arguments: argparse.Namespace, name: str) -> str:
    """Return the text to write: the template called `name`, or the robot of another program's file; raises
    CtrError.
    """
    given = {f"--{key.replace('_', '-')}": getattr(arguments, key) for key in ("name", "poisson_ratio")}
    if arguments.source is None:
        for option in (option for option, value in given.items() if value is not None):
            raise OptionError(f"{option} says what to take from another program's file; name that with --from")
        return template(name)
    if arguments.kind != "robot":
        raise OptionError(f"--from is given for a {arguments.kind} file; only a robot is read from other programs")
    from ctr_nlp.view.exchange.robots import read_robot  # brings numerics, which templates do without

    imported = read_robot(arguments.source, arguments.name, arguments.poisson_ratio)
    return imported.to_toml(Path(arguments.source).name)


def _run(arguments: argparse.Namespace) -> int:
    name = TEMPLATE_BY_KIND[arguments.kind]
    file = Path(arguments.file)
    if file.suffix != Path(name).suffix:
        raise OptionError(f"file is {file}; the name of a {arguments.kind} file ends in {Path(name).suffix}")
    if file.exists() or file.is_symlink():
        raise OutputError(f"{file} exists and is left as it is; name another file")
    check_file(file, "")
    write_text(file, _text(arguments, name))
    report_written_files(file, more=f"; next: {NEXT_COMMAND_BY_TEMPLATE[name].format(file=file)}")
    return EXIT_SOLVED


main = Command("ctr-nlp new", _parser, _run)

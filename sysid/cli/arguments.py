"""The command line's arguments: every command with its options, its help and its examples.

Mistakes in them are told in one line; numbers are refused with an example of a right one.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import textwrap
from collections.abc import Callable
from typing import Any, NoReturn, get_args

from sysid.errors import InputError
from sysid.files import description
from sysid.results.version import __version__
from sysid.search.auto import NAMED
from sysid.search.swarm_objective import RefineBy

Adder = Callable[..., argparse.ArgumentParser]

JSON, QUIET, TRUST = "--json", "--quiet", "--trust"


class Parser(argparse.ArgumentParser):
    """Mistakes become an InputError, so that they are one line like all others."""

    def error(self, message: str) -> NoReturn:
        """Raise it."""
        raise InputError(f"{message} (see '{self.prog} --help')")


def command_parser() -> argparse.ArgumentParser:
    """The parser of the command line; `command` of what it parses is the name of the command."""
    parser = Parser(
        prog="sysid",
        description="Mass, stiffness and damping matrices of a structure from shaker-table tests.",
        epilog=_epilog(
            ("sysid run cantilever_tower", "sysid read sine.csv --sensors sensors.toml --out test.h5",
             "sysid run test.h5 --mass 1450", "sysid export results/test test.bdf", "sysid run --help"),
            "Exit status: 0 determined or one of many, 1 doubtful or no fit, 2 a mistake in what was\n"
            "given, 130 interrupted (the best so far is saved), 70 an error of sysid itself.",
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"sysid {__version__}")
    command = functools.partial(_add, parser.add_subparsers(metavar="COMMAND", required=True))
    command("list", summary="list the problems that can be run by name", examples=("sysid list",))
    for add in (_add_new, _add_show, _add_read, _add_run, _add_compare, _add_refine, _add_report, _add_export):
        add(command)
    doctor = command(
        "doctor",
        summary="tell what this installation has, or what a file of a logger holds, what it lacks, and how to get that",
        description="Tell versions of Python and packages, the solvers that work here, threads, and which extras are "
        "installed, with the command for those that are not. Exit status 2 where a search could not work. Of files: "
        "their channels, the kind of test that they seem to be, and what is still to be said.",
        examples=("sysid doctor", "sysid doctor --json", "sysid doctor sine.csv"),
    )
    doctor.add_argument("files", metavar="FILE", nargs="*", help="files of a logger, such as 'sysid read' takes")
    return parser


def _epilog(examples: tuple[str, ...], more: str = "") -> str:
    """The end of a help: examples, a line each, then text that keeps its lines."""
    listing = "\n".join(f"  {example}" for example in examples)
    return f"examples:\n{listing}\n" + (f"\n{more}" if more else "")


def _add(
    commands: Any, name: str, *, summary: str, examples: tuple[str, ...], description: str = "", more: str = ""
) -> argparse.ArgumentParser:
    """Add a command: `summary` is for the list of commands, a test runs `examples`, `more` keeps its lines."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=textwrap.fill(description or f"{summary[0].upper()}{summary[1:]}.", 79),
        epilog=_epilog(examples, more),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    command.set_defaults(command=name)
    command.add_argument(
        JSON, action="store_true", help="print one JSON document in the place of words: of a mistake too"
    )
    command.add_argument(
        QUIET, action="store_true", help="print nothing but warnings and mistakes: exit status and files tell"
    )
    return command


def _add_new(command: Adder) -> None:
    new = command(
        "new",
        summary="write a commented problem module and its test here",
        description="Write NAME.py, a commented problem that runs at once, and test_NAME.py; never over a file.",
        examples=("sysid new my_building", "sysid new my_tower --data test.h5"),
    )
    new.add_argument("name", metavar="NAME", help="a name that Python can import: letters, digits, underscores")
    new.add_argument("--data", metavar="TEST.h5", help="a test that 'sysid read' wrote: a module that identifies it")


def _add_show(command: Adder) -> None:
    show = command(
        "show",
        summary="tell the unknowns of a problem and what its data determine, without a search",
        description="Tell the unknowns of a problem, their bounds and scaling, and what the data determine: rank and "
        "unseen directions of the exact Jacobian at the reference, where it is known, or at a guess. Of a result.h5 "
        "or its folder the summary, of a test that 'sysid read' wrote the channels.",
        examples=("sysid show shear_building", "sysid show my_building.py", "sysid show results/cantilever_tower"),
    )
    _add_problem(show)
    show.add_argument(
        "--seed", type=_seed, metavar="N", help="reaches problem() as rng: of simulated noise; 0 by default"
    )


def _add_run(command: Adder) -> None:
    run = command(
        "run",
        summary="identify the structure of a problem",
        description="Identify the structure of a problem, or of a test that 'sysid read' wrote (sysid run test.h5: "
        "full mass, free stiffness and modal damping, of the modes within the lines). Writes result.h5, "
        "summary.json and report.html.",
        examples=(
            "sysid run cantilever_tower",
            "sysid run cantilever_tower --set elements=3 --set noise=0.01 --out results/noisy",
            "sysid run my_building.py --max-time 60 --quiet",
            "sysid run test.h5 --mass 1450",
            "sysid run test.h5 --band 0.5-20",
            "sysid run test.h5 --modes 1 --dofs top",
        ),
    )
    _add_problem(run, optional=True)
    _add_test_options(run)
    _add_modal_options(run)
    run.add_argument(
        "--seed", type=_seed, metavar="N",
        help="of the search, 0 by default: the same seed gives the same result. The simulated noise of a problem is "
        "part of the problem and does not change with it",
    )  # fmt: skip
    run.add_argument(
        "--strategy", choices=("auto", *NAMED), metavar="S",
        help="modal: modes from the data, without a search; continuation: gradients through widened peaks, for "
        "structured models and variables of your own; swarm: the particle swarm and its refinement; hpso-ls: the "
        "published swarm, eigenvalue refinement and IPOPT in Cholesky coordinates; auto, by default: "
        "modal where the models of the problem allow it, continuation where they have a form of their own, else swarm",
    )  # fmt: skip
    run.add_argument(
        "--refine-by", choices=get_args(RefineBy), metavar="WAY",
        help="how swarm and hpso-ls give a candidate the measured frequencies: closed-form (swarm by default), the "
        "nearest matrix; ipopt, the paper's nonlinear programme for every candidate, for small problems; leaders "
        "(hpso-ls by default), the closed form, and IPOPT for each new leader of the swarm",
    )  # fmt: skip
    run.add_argument(
        "--out", metavar="DIR", help="folder of the results, results/NAME by default; one run at a time writes there"
    )
    run.add_argument(
        "--max-time", type=_seconds, metavar="S",
        help="end after about so many seconds; a report that they do not suffice for is left to 'sysid report'",
    )  # fmt: skip
    run.add_argument(
        "--resume", metavar="DIR",
        help="go on with the killed or interrupted run in this folder; a PROBLEM that is not bundled is said again",
    )  # fmt: skip
    _add_trust(run, "the unfinished run")
    run.add_argument("--fresh", action="store_true", help="begin anew where there is an unfinished run in the folder")


def _add_test_options(run: argparse.ArgumentParser) -> None:
    """Add what may be said of a test file: masses, lines that are fitted, and what is near enough."""
    run.add_argument(
        "--mass", type=_masses, metavar="KG",
        help="of TEST.h5: mass of the structure, kg, a number or one a direction: 1450 or 1450,1450,1450; with "
        "--lumped that at the sensors alone, without what moves with the table (adapter, base ring)",
    )  # fmt: skip
    run.add_argument("--lumped", action="store_true", default=None, help="of TEST.h5: masses at the sensors alone")
    run.add_argument(
        "--band", type=_band, metavar="LOW-HIGH",
        help="of TEST.h5: the lines that are fitted, Hz, such as 0.5-40; those that the base excites, of records in "
        "time, unless given",
    )  # fmt: skip
    run.add_argument(
        "--goal", type=_share, metavar="SHARE",
        help="of TEST.h5: relative residual that is near enough, such as 0.05; by default that of the noise",
    )  # fmt: skip
    run.add_argument(
        "--gain-std", type=_share, metavar="SHARE",
        help="of TEST.h5: tolerance of the gains of all channels, base and force included, as a standard deviation, "
        "such as 0.005; those that the sensors' list states, exact where it states none",
    )  # fmt: skip
    run.add_argument("--amplitude", action="store_true", default=None, help="of TEST.h5: modes follow their amplitude")
    run.add_argument(
        "--at-rest", action="store_true", default=None,
        help="of TEST.h5: all records begin and end at rest, as they were recorded without a window, and have no "
        "transients",
    )  # fmt: skip


def _add_modal_options(command: argparse.ArgumentParser) -> None:
    """Add what may be asked of the modal strategy."""
    command.add_argument(
        "--modes", type=_count, metavar="N",
        help="so many modes within the lines, in place of all that stand out of the noise; residual modes, which stand "
        "for what is beyond the lines, are not counted",
    )  # fmt: skip
    command.add_argument(
        "--dofs", type=_names, metavar="NAME,...",
        help="the sensors that M, K and C stand on, such as tip,panel: at most one a mode; chosen unless given",
    )  # fmt: skip


def _add_compare(command: Adder) -> None:
    compare = command(
        "compare",
        summary="run all strategies on a problem, and other optimisers, side by side",
        description="Run every strategy that applies and, where the extra 'benchmark' is installed, optimisers of "
        "pymoo, cma and SciPy on the objective of the swarm, with its number of evaluations and the same local phase. "
        "Prints one table and writes one picture, comparison.png.",
        examples=("sysid compare shear_building --max-time 1 --out side_by_side",),
    )
    _add_problem(compare)
    _add_modal_options(compare)
    compare.add_argument("--seed", type=_seed, default=0, metavar="N", help="of all methods, 0 by default")
    compare.add_argument(
        "--out", metavar="DIR",
        help="folder of the picture, results/NAME by default; the table goes there too (CSV, JSON)",
    )  # fmt: skip
    compare.add_argument("--max-time", type=_seconds, metavar="S", help="end each method after about so many seconds")


def _add_read(command: Adder) -> None:
    read = command(
        "read",
        summary="read the files of a logger as a test that 'sysid run' takes",
        description="Read the files of a test, convert its channels to SI units, print a table of them, and write it. "
        "Which column is which sensor is said in a TOML file or by --sensor; a TOML file of the name of the first "
        "file, or sensors.toml beside it, is found by itself.",
        examples=(
            "sysid read sine.csv --sensors sensors.toml --out test.h5",
            "sysid read CH1.csv CH2.csv --join --sensors sensors.toml --out test.h5",
            "sysid read run1.csv run2.csv --time Time --sensor CH1 role=base axis=x unit=g \\\n"
            "      --sensor CH2 role=response name=top axis=x position=0,0,3 unit=g --out test.h5",
        ),
        more=f"sensors.toml:\n{description.EXAMPLE}",
    )
    read.add_argument("files", metavar="FILE", nargs="+", help="of any known format; each is a run")
    read.add_argument("--out", metavar="TEST.h5", help="file to write, test.h5 by default")
    read.add_argument("--sensors", metavar="TOML", help="which column is which sensor")
    read.add_argument(
        "--sensor", action="append", nargs="+", default=[], metavar=("COLUMN", "KEY=VALUE"),
        help="one sensor: role=base|response|force axis=x position=0,0,3 unit=g gain=0.995 delay=0.002 part=A name=B",
    )  # fmt: skip
    read.add_argument("--rate", type=float, metavar="HZ", help="samples a second, where no column has the time")
    read.add_argument("--time", metavar="COLUMN", help="the column of time")
    read.add_argument("--frequency", metavar="COLUMN", help="the column of frequencies, of spectra")
    read.add_argument(
        "--join", action="store_true", default=None,
        help="each file has one sensor: the files of a folder, or those that share the rest of their names (run1_top, "
        "run1_table), are one run; columns are called FILE, or FILE.COLUMN of several",
    )  # fmt: skip
    read.add_argument(
        "--align", action="store_true", default=None,
        help="files of a run that have clocks of their own are brought to that of the base by the motion they share",
    )  # fmt: skip
    read.add_argument("--base-axes", metavar="AXES", help='along which the base moves, such as "x" or "x rz"')
    read.add_argument("--frf", metavar="FORM", help="of frequency responses: transmissibility, accelerance, mobility, "
                      "receptance, apparent mass")  # fmt: skip
    read.add_argument("--convention", metavar="SIGN", help='of spectra: "exp(+iwt)" or "exp(-iwt)"')
    read.add_argument(
        "--window", metavar="hann", help="of frequency responses that an analyser averaged: its window, hann"
    )
    read.add_argument(
        "--averages", type=int, metavar="N",
        help="of how many independent segments: coherences in the files then tell the noise",
    )  # fmt: skip


def _add_refine(command: Adder) -> None:
    refine = command(
        "refine",
        summary="jobs about a result: many starts, draws of noise, parts of its test, other models",
        description="Run many jobs about a result, on all processors or a cluster: the local phase from the result and "
        "from fresh points of the search space, or one of the other kinds below. Prints one table, and writes it and a "
        "picture. Results are kept as they come: the same command goes on where it was interrupted.",
        examples=(
            "sysid refine results/noisy --starts 4",
            "sysid refine results/noisy --draws 8 --workers 1",
            "sysid refine results/noisy --leave-out sensor --json",
        ),
    )
    refine.add_argument("result", metavar="RESULT", help="a result.h5 that 'sysid run' wrote, or its folder")
    refine.add_argument(
        "--module", metavar="FILE",
        help="the problem module of RESULT, in the place of the one that RESULT names; a bundled one need not be named",
    )  # fmt: skip
    _add_trust(refine, "RESULT")
    _add_kinds(refine)
    refine.add_argument("--workers", type=_count, metavar="N", help="processes, as many as processors by default")
    refine.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    refine.add_argument("--out", metavar="DIR", help="folder, RESULT's folder/refine by default")


def _add_kinds(refine: argparse.ArgumentParser) -> None:
    """Add the kinds of jobs, of which one is asked for."""
    kinds = refine.add_mutually_exclusive_group()
    kinds.add_argument(
        "--starts", type=_count, metavar="N",
        help="16 by default; the first is the result. Tells the distinct minima, and how often each was reached",
    )  # fmt: skip
    kinds.add_argument(
        "--draws", type=functools.partial(_whole, 2), metavar="N",
        help="fits of N sets of records that the result would have given, with noise drawn anew: their spread beside "
        "the linear uncertainty; an answer in the band, or with coupled damping, is identified anew from each",
    )  # fmt: skip
    kinds.add_argument(
        "--leave-out", choices=("run", "sensor"),
        help="identify without each run, or each sensor, in turn: how far the answer moves, and how well it predicts "
        "what was left out",
    )  # fmt: skip
    kinds.add_argument(
        "--bands", type=_band, nargs="+", metavar="LOW-HIGH",
        help="identify from the lines of each band, in Hz: how far the answer moves with the band",
    )  # fmt: skip
    kinds.add_argument(
        "--orders", type=_orders, metavar="A-B",
        help="identify with A to B modes of those that stand out of the noise, where mass and stiffness are free: AIC, "
        "BIC and the residual of the validation tests",
    )  # fmt: skip
    kinds.add_argument(
        "--variants", nargs="+", metavar="MODULE",
        help="identify by other problem modules from the same data: AIC, BIC and the residual of the validation tests",
    )  # fmt: skip


def _add_report(command: Adder) -> None:
    report = command(
        "report",
        summary="write report.html again, beside a result",
        examples=("sysid report results/cantilever_tower", "sysid report results/cantilever_tower/result.h5"),
    )
    _add_result(report)


def _add_export(command: Adder) -> None:
    export = command(
        "export",
        summary="write the identified structure for another program",
        description="Write the identified structure for another program, in the format that the ending of FILE tells: "
        ".csv, M, K and C with deviations (exact); .mat, MATLAB (exact); .op4, Nastran OUTPUT4 "
        "with the Craig-Bampton superelement (exact); .bdf or .dmig, the superelement as Nastran's DMIG (10 digits); "
        ".unv or .uff, mode shapes as dataset 55 (6 digits). "
        "The file says what the matrices are worth, what speaks against them and what the data leave open; where they "
        "are not determined, a warning says so.",
        examples=tuple(
            f"sysid export results/cantilever_tower tower.{ending}" for ending in ("csv", "mat", "op4", "bdf", "unv")
        ),
    )
    _add_result(export)
    export.add_argument("file", metavar="FILE", help="the file to write")
    export.add_argument("--positive-axes", action="store_true", help="turn sensors along -x, -y, -z to +x, +y, +z")
    export.add_argument("--level", type=float, metavar="A", help="m/s², of modes that follow their amplitude; else 0")


def _add_problem(command: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Give a command the problem module, which may be `optional`, and what is handed on to it."""
    command.add_argument(
        "problem", metavar="PROBLEM", nargs="?" if optional else None,
        help="a path to a module (.py), else a module in ./problems, else a bundled problem, else a dotted module"
        + "; or the path to a test that 'sysid read' wrote" * optional,
    )  # fmt: skip
    command.add_argument("--data", metavar="PATH", help="file or folder of records, for problems that read some")
    command.set_defaults(modes=None, dofs=())
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="a keyword parameter of the module's problem(), such as elements=3: a number, a list or what else Python "
        "can read, else a text; may be given several times",
    )  # fmt: skip


def _add_trust(command: argparse.ArgumentParser, of: str) -> None:
    """Give a command ``--trust``; `of` is the file that names a module."""
    command.add_argument(
        TRUST, action="store_true",
        help=f"run the problem module that {of} names, with your rights on this machine: its code may do anything, so "
        "say this of files of your own alone. Problems that come with the package need it not",
    )  # fmt: skip


def _add_result(command: argparse.ArgumentParser) -> None:
    """Add RESULT and ``--module``."""
    command.add_argument("result", metavar="RESULT", help="a result.h5, or the folder that holds it")
    command.add_argument(
        "--module", metavar="FILE",
        help="the problem module that RESULT was made by, which is run: where RESULT does not hold all of its problem, "
        "and more is wanted than figures, report and matrices, which it always holds",
    )  # fmt: skip


def _band(text: str) -> tuple[float, float]:
    """Ends of a band, Hz, of LOW-HIGH."""
    low, _, high = text.rpartition("-")  # at the last dash, as 1e-3 has one too
    try:
        ends = float(low), float(high)
    except ValueError:
        ends = 0.0, 0.0
    if not 0 <= ends[0] < ends[1] < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no band: write its ends in Hz, such as 0.5-20")
    return ends


def _share(text: str) -> float:
    """A share, which is no per cent."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no share: 0.005 is half a per cent")
    return value


def _orders(text: str) -> tuple[int, int]:
    """The least and the largest number of modes, of A-B."""
    low, _, high = text.partition("-")
    if not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high)):
        raise argparse.ArgumentTypeError(f"{text!r} is no range of numbers of modes: write 3-8")
    return int(low), int(high)


def _whole(least: int, text: str) -> int:
    """A whole number from the least one."""
    with contextlib.suppress(ValueError):
        if (given := int(text)) >= least:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")


_count, _seed = functools.partial(_whole, 1), functools.partial(_whole, 0)


def _names(text: str) -> tuple[str, ...]:
    """Names of sensors."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of sensors: write their names with commas, as tip,panel")
    return names


def _seconds(text: str) -> float:
    """A positive number of seconds."""
    with contextlib.suppress(ValueError):
        if 0 < (given := float(text)) < math.inf:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")


def _masses(text: str) -> float | list[float]:
    """A mass, or one a direction."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no mass in kg, such as 1450")
    return found if found[1:] else found[0]

"""Commands: ``sysid list``, ``new``, ``read``, ``show``, ``run``, ``compare``, ``refine``, ``report``, ``export``.

Exit status: 0 success; 1 the search did not reach its goal; 2 a mistake in what was given, told in
one line; 130 interrupted, with the best so far saved; 70 an error of sysid itself, told in one line
with the traceback in a log file.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NoReturn, cast

from sysid import catalogue
from sysid.cli import export, parameters, read, starting, unfinished
from sysid.cli.display import Output, collected_warnings, complain, display_on
from sysid.cli.files import strict_json
from sysid.cli.status import BUG, INTERRUPTED, MISTAKE, NOT_REACHED, SUCCESS
from sysid.errors import InputError, SolverError
from sysid.identify import NAMED, identify
from sysid.results.checkpoint import FILE_NAME as UNFINISHED
from sysid.results.checkpoint import Checkpoint
from sysid.results.identification import Identification, load
from sysid.results.storage import FILE_NAME as RESULT
from sysid.results.storage import atomically, missing_folders, remove_empty
from sysid.results.version import __version__
from sysid.search.deadline import TimeIsOver, within
from sysid.search.session import LEAST, DeferredInterrupt

_LOG = "sysid-error.log"
_SUMMARY = "summary.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process by default.

    Returns
    -------
    int
        Exit status.
    """
    out = Output(sys.stdout)
    # Whatever argparse, a problem module or CasADi prints passes through it too.
    with contextlib.redirect_stdout(cast(IO[str], out)):
        status = _run_command(argv, out)
    out.flush()
    if out.failed is not None:
        # What is left in the interpreter's own buffer would fail once more at exit.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(out.failed, BrokenPipeError):  # a reader that has seen enough is no mistake
            complain(f"standard output cannot be written: {out.failed.strerror}")
            status = status or MISTAKE
    return status


def command() -> NoReturn:
    """Run the command line and end the process, which no Ctrl-C breaks any more once its status is known."""
    try:
        status = main()
    except KeyboardInterrupt:  # one more, while the first one was told
        status = INTERRUPTED
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(status)


def _run_command(argv: Sequence[str] | None, out: Output) -> int:
    """Parse and run; every exception becomes one line and a status."""
    try:
        starting.is_over()
        options = _parser().parse_args(argv)
        with collected_warnings() as remarks:
            status = int(options.command(options, out))
        for remark in remarks:
            complain(f"warning: {remark}")
        return status
    except SystemExit as end:  # argparse, after --help or --version
        return int(end.code or 0)
    except InputError as error:
        complain(error)
        return MISTAKE
    except SolverError as error:
        complain(error)
        return NOT_REACHED
    except KeyboardInterrupt:
        complain(starting.NOTHING_SAVED)
        return INTERRUPTED
    except Exception as error:
        log = _write_log()
        complain(f"an error of sysid itself ({type(error).__name__}: {error}); {log}")
        return BUG


# -- the commands -------------------------------------------------------------------------------


def _list(options: argparse.Namespace, out: Output) -> int:
    entries = catalogue.entries()
    width = max((len(entry.name) for entry in entries), default=0)
    for entry in entries:
        own = "" if entry.bundled else f"  ({entry.path})"
        out.write(f"{entry.name:{width}}  {entry.description}{own}\n")
    if not entries:
        out.write("no problems found; a path to a module does as well: sysid run PATH\n")
    return SUCCESS


def _new(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli import new

    module, test = new.write(options.name, data=options.data)
    out.write(
        f"{module} and {test} are written. Try them, then change the steps of {module} into your own:\n"
        f"  sysid show {module}    what is unknown, and what the data determine\n"
        f"  sysid run {module}     identify, and write results/{module.stem}/report.html\n"
        f"  python -m pytest {test}\n"
    )
    return SUCCESS


def _show(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli.show import show

    recipe = parameters.recipe_of(options, options.seed)
    out.write(f"{show(catalogue.build(recipe), recipe.title)}\n")
    return SUCCESS


def _run(options: argparse.Namespace, out: Output) -> int:
    begun = time.perf_counter()

    def left(least: float) -> float | None:
        """Seconds that are left, at least so many; None without a limit."""
        return None if options.max_time is None else max(options.max_time - (time.perf_counter() - begun), least)

    search, folder = unfinished.begun(options, out)
    recipe = search.recipe
    problem, files = catalogue.built(recipe, check=options.max_time is None)  # with a limit under the search's clock
    checkpoint = Checkpoint(folder / UNFINISHED, unfinished.with_source(search, files, folder))
    if options.fresh:
        checkpoint.remove()
    test = problem.measurement
    # Poles of the data, which may take long, are left to the search and its progress and time limit.
    unknowns = problem.formulate(problem.geometry.unsearched()).size
    out.write(
        f"{recipe.title}: {test.n_sensors} sensors, base moving along {' '.join(test.base_axes or ())}, "
        f"{test.freq.size} lines from {test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz, "
        f"{unknowns} unknowns{'' if recipe.module == read.MODULE else f', seed {search.seed}'}\n"
    )
    failed: InputError | None = None
    # From the search's end until the result is on the disk Ctrl-C waits, however often.
    with DeferredInterrupt(patience=None) as late:
        with display_on(out) as display:
            result = identify(
                problem, strategy=search.strategy, rng=search.seed, max_time=left(LEAST), progress=display,
                checkpoint=checkpoint,
            )  # fmt: skip
        result = replace(result, recipe=recipe)
        try:
            _save(result, folder, checkpoint)
        except InputError as error:
            failed = error
    try:
        words, figures = _told(result, left(LEAST))
        out.write(f"\n{words}\n\n")
        out.flush()
        if failed is not None:
            raise failed
        # Raised while matplotlib's objects are collected it would be lost, with a traceback.
        with DeferredInterrupt() as writing:
            _write_pages(result, figures, folder, out, left(0.0))
    except KeyboardInterrupt:
        complain(f"interrupted while saving; the result is there, but not every file is in {folder}")
        return INTERRUPTED
    if late.asked or writing.asked or result.interrupted:
        on = f"; 'sysid run --resume {folder}' goes on" if checkpoint.exists else ""
        complain(f"interrupted; the {'best so far' if result.interrupted else 'result'} is in {folder}{on}")
        return INTERRUPTED
    return SUCCESS if result.success else NOT_REACHED


def _compare(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli import compare

    return compare.run(options, out)


def _refine(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli import refine

    return refine.run(options, out)


def _report(options: argparse.Namespace, out: Output) -> int:
    from sysid.report import report

    source = Path(options.result)
    result = load(source)
    folder = source if source.is_dir() else source.parent
    out.write(f"{report.write(result, folder / report.FILE_NAME)}\n")
    return SUCCESS


# -- arguments ----------------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """Mistakes become an InputError, so that they are one line like all others."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see '{self.prog} --help')")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="sysid",
        description="Mass, stiffness and damping matrices of a structure from shaker-table tests.",
        epilog="Exit status: 0 success, 1 the search did not reach its goal, 2 a mistake in what was given, "
        "130 interrupted (the best so far is saved), 70 an error of sysid itself.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"sysid {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    command = functools.partial(commands.add_parser, allow_abbrev=False)

    lister = command("list", help="list the problems that can be run by name")
    lister.set_defaults(command=_list)

    new = command(
        "new",
        help="write a commented problem module and its test here",
        description="Write NAME.py, a commented problem that runs at once, and test_NAME.py; never over a file.",
    )
    new.add_argument("name", metavar="NAME", help="a name that Python can import: letters, digits, underscores")
    new.add_argument("--data", metavar="TEST.h5", help="a test that 'sysid read' wrote: a module that identifies it")
    new.set_defaults(command=_new)

    show = command(
        "show",
        help="tell the unknowns of a problem and what its data determine, without a search",
        description="Tell the unknowns of a problem, their bounds and scaling, and what the data determine: rank and "
        "unseen directions of the exact Jacobian at the reference, where it is known, or at a guess.",
    )
    parameters.add_arguments(show)
    show.add_argument(
        "--seed", type=_seed, metavar="N", help="reaches problem() as rng: of simulated noise; 0 by default"
    )
    show.set_defaults(command=_show)

    read.add(command)
    _add_run(command)
    _add_compare(command)
    _add_refine(command)

    report = command("report", help="write report.html again, beside a result")
    report.add_argument("result", metavar="RESULT", help="a result.h5, or the folder that holds it")
    report.set_defaults(command=_report)

    export.add(command)
    return parser


def _add_run(command: Callable[..., argparse.ArgumentParser]) -> None:
    run = command(
        "run",
        help="identify the structure of a problem",
        description="Identify the structure of a problem, or of a test that 'sysid read' wrote (sysid run test.h5). "
        "Writes result.h5, summary.json and report.html.",
    )
    parameters.add_arguments(run, optional=True)
    read.add_masses(run)
    run.add_argument(
        "--seed",
        type=_seed,
        metavar="N",
        help="of the search, 0 by default: the same seed gives the same result. The simulated noise of a problem is "
        "part of the problem and does not change with it",
    )
    run.add_argument(
        "--strategy",
        choices=("auto", *NAMED),
        metavar="S",
        help="modal: modes from the data, without a search; continuation: gradients through widened peaks, for "
        "structured models and variables of your own; swarm: the particle swarm and its refinement; hpso-ls: the "
        "published swarm, eigenvalue refinement and IPOPT in Cholesky coordinates; auto, by default: "
        "modal where the models of the problem allow it, continuation where they have a form of their own, else swarm",
    )
    run.add_argument("--out", metavar="DIR", help="folder of the results, results/NAME by default")
    run.add_argument(
        "--max-time",
        type=_seconds,
        metavar="S",
        help="end after about so many seconds; a report that they do not suffice for is left to 'sysid report'",
    )
    run.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the run in this folder that was killed or interrupted; PROBLEM and its options need not be "
        "said again",
    )
    run.add_argument("--fresh", action="store_true", help="begin anew where there is an unfinished run in the folder")
    run.set_defaults(command=_run)


def _add_compare(command: Callable[..., argparse.ArgumentParser]) -> None:
    compare = command(
        "compare",
        help="run all strategies on a problem, and other optimisers, side by side",
        description="Run every strategy that applies and, where the extra 'benchmark' is installed, optimisers of "
        "pymoo, cma and SciPy on the objective of the swarm, with its number of evaluations and the same local phase. "
        "Prints one table and writes one picture, comparison.png.",
    )
    parameters.add_arguments(compare)
    compare.add_argument("--seed", type=_seed, default=0, metavar="N", help="of all methods, 0 by default")
    compare.add_argument(
        "--out",
        metavar="DIR",
        help="folder of the picture, results/NAME by default; the table goes there too (CSV, JSON)",
    )
    compare.add_argument("--max-time", type=_seconds, metavar="S", help="end each method after about so many seconds")
    compare.set_defaults(command=_compare)


def _add_refine(command: Callable[..., argparse.ArgumentParser]) -> None:
    refine = command(
        "refine",
        help="jobs about a result: many starts, draws of noise, parts of its test, other models",
        description="Run many jobs about a result, on all processors or a cluster: the local phase from the result and "
        "from fresh points of the search space, or one of the other kinds below. Prints one table, and writes it and a "
        "picture. Results are kept as they come: the same command goes on where it was interrupted.",
    )
    refine.add_argument("result", metavar="RESULT", help="a result.h5 that 'sysid run' wrote, or its folder")
    kinds = refine.add_mutually_exclusive_group()
    kinds.add_argument(
        "--starts",
        type=_count,
        metavar="N",
        help="16 by default; the first is the result. Tells the distinct minima, and how often each was reached",
    )
    kinds.add_argument(
        "--draws",
        type=functools.partial(_whole, 2),
        metavar="N",
        help="fits of N sets of records that the result would have given, with noise drawn anew: their spread beside "
        "the linear uncertainty",
    )
    kinds.add_argument(
        "--leave-out",
        choices=("run", "sensor"),
        help="identify without each run, or each sensor, in turn: how far the answer moves, and how well it predicts "
        "what was left out",
    )
    kinds.add_argument(
        "--bands",
        type=_band,
        nargs="+",
        metavar="LOW-HIGH",
        help="identify from the lines of each band, in Hz: how far the answer moves with the band",
    )
    kinds.add_argument(
        "--orders",
        type=_orders,
        metavar="A-B",
        help="identify with A to B modes of those that stand out of the noise, where mass and stiffness are free: AIC, "
        "BIC and the residual of the validation tests",
    )
    kinds.add_argument(
        "--variants",
        nargs="+",
        metavar="MODULE",
        help="identify by other problem modules from the same data: AIC, BIC and the residual of the validation tests",
    )
    refine.add_argument("--workers", type=_count, metavar="N", help="processes, as many as processors by default")
    refine.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    refine.add_argument("--out", metavar="DIR", help="folder, RESULT's folder/refine by default")
    refine.set_defaults(command=_refine)


def _band(text: str) -> tuple[float, float]:
    low, _, high = text.rpartition("-")  # at the last dash, as 1e-3 has one too
    try:
        ends = float(low), float(high)
    except ValueError:
        ends = 0.0, 0.0
    if not 0 <= ends[0] < ends[1] < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no band: write its ends in Hz, such as 0.5-20")
    return ends


def _orders(text: str) -> tuple[int, int]:
    low, _, high = text.partition("-")
    if not (low.isdecimal() and high.isdecimal() and 1 <= int(low) <= int(high)):
        raise argparse.ArgumentTypeError(f"{text!r} is no range of numbers of modes: write 3-8")
    return int(low), int(high)


def _whole(least: int, text: str) -> int:
    with contextlib.suppress(ValueError):
        if (given := int(text)) >= least:
            return given
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least}")


_count, _seed = functools.partial(_whole, 1), functools.partial(_whole, 0)


def _seconds(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0 < (seconds := float(text)) < math.inf:
            return seconds
    raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")


# -- files --------------------------------------------------------------------------------------


def _save(result: Identification, folder: Path, checkpoint: Checkpoint) -> None:
    """Write a result, then take away what it replaces."""
    from sysid.report import report

    missing = missing_folders(folder)
    try:
        result.save(folder / RESULT)
        for name in (_SUMMARY, report.FILE_NAME):  # those of another result must not stand beside this one
            (folder / name).unlink(missing_ok=True)
        if not result.interrupted:
            checkpoint.remove()
    except OSError as error:
        raise InputError(f"folder of results {folder}: {error.strerror or error}") from error
    finally:
        remove_empty(missing)  # where nothing could be written


def _told(result: Identification, left: float | None) -> tuple[str, dict[str, Any]]:
    """Summary and figures of a result; without what takes more than the seconds that are `left`."""
    try:
        with within(left):
            return result.summary(), result.to_dict()
    except TimeIsOver:
        hurried = replace(result, hurried=True)
        return hurried.summary(), hurried.to_dict()


def _write_pages(
    result: Identification, figures: dict[str, Any], folder: Path, out: Output, left: float | None
) -> None:
    """Write what people and scripts read of a result that is saved, each file whole or not at all.

    The page is left out where it takes more than the seconds that are `left`.
    """
    from sysid.report import report

    out.write(f"result   {folder / RESULT}\n")
    summary = folder / _SUMMARY
    with atomically(summary) as temporary:
        temporary.write_text(strict_json(figures), encoding="utf-8")
    out.write(f"summary  {summary}\n")
    try:
        with within(left):
            out.write(f"report   {report.write(result, folder / report.FILE_NAME)}\n")
    except TimeIsOver:
        out.write(f"no report, as the time is over: 'sysid report {folder}' writes it\n")


def _write_log() -> str:
    """Write the traceback of the exception at hand; what to tell about it."""
    text = f"sysid {__version__}, Python {sys.version}\n{sys.argv}\n\n{traceback.format_exc()}"
    for folder in (Path(), Path(tempfile.gettempdir())):
        log = folder / _LOG
        with contextlib.suppress(OSError):
            log.write_text(text, encoding="utf-8", errors="backslashreplace")
            return f"the traceback is in {log.absolute()}"
    return "no log file could be written"

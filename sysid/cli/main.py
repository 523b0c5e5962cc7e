"""Commands: ``sysid list``, ``new``, ``read``, ``show``, ``run``, ``compare``, ``refine``, ``report``, ``export``.

What they say is words, or with ``--json`` one document, on standard output; progress, warnings and mistakes are on
standard error. Exit status: 0 determined or one of many; 1 doubtful or no fit; 2 a mistake in what was given, told in
one line; 130 interrupted, with the best so far saved; 70 an error of sysid itself, told in one line with the traceback
in a log file.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, NoReturn, cast, get_args

from sysid import catalogue
from sysid.cli import doctor, export, parameters, read, starting, stored_result, trust, unfinished
from sysid.cli.command_parser import JSON, QUIET, Parser, adder, band, count, epilog, orders, seconds, seed, whole
from sysid.cli.display import display_on
from sysid.cli.files import alone_in, replaced_in_words, save, summary_and_figures, write_pages
from sysid.cli.output import Output, collected_warnings, keep_for_document
from sysid.cli.status import BUG, INTERRUPTED, MISTAKE, NOT_REACHED, SUCCESS
from sysid.errors import InputError, SolverError
from sysid.identify import identify
from sysid.results.checkpoint import FILE_NAME as UNFINISHED
from sysid.results.checkpoint import Checkpoint
from sysid.results.version import __version__
from sysid.search.auto import NAMED
from sysid.search.session import GRACE, DeferredInterrupt
from sysid.search.swarm_objective import RefineBy

_LOG = "sysid-error.log"


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
    given = sys.argv[1:] if argv is None else argv
    out = Output(json=JSON in given, quiet=QUIET in given)  # known before arguments are parsed, for what is wrong there
    with contextlib.redirect_stdout(cast(IO[str], out.prints)):
        status = _run_command(given, out)
    return out.end(status)


def command() -> NoReturn:
    """Run the command line and end the process, which no Ctrl-C breaks any more once its status is known."""
    try:
        if JSON in sys.argv:
            keep_for_document()
        status = main()
    except KeyboardInterrupt:  # one more, while the first one was told
        status = INTERRUPTED
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(status)


def _run_command(argv: Sequence[str], out: Output) -> int:
    """Parse and run; every exception becomes one line and a status."""
    try:
        starting.is_over()
        options = _parser().parse_args(argv)
        with collected_warnings() as remarks:
            status = int(options.command(options, out))
        for remark in remarks:
            out.warn(remark)
        return status
    except SystemExit as end:  # argparse, after --help or --version
        return int(end.code or 0)
    except InputError as error:
        out.complain(error)
        return MISTAKE
    except SolverError as error:
        out.complain(error)
        return NOT_REACHED
    except KeyboardInterrupt as interrupt:
        out.complain(": ".join(filter(None, (starting.NOTHING_SAVED, str(interrupt)))))
        return INTERRUPTED
    except Exception as error:
        log = _write_log()
        out.complain(f"an error of sysid itself ({type(error).__name__}: {error}); {log}")
        return BUG


# -- the commands -------------------------------------------------------------------------------


def _list(options: argparse.Namespace, out: Output) -> int:
    entries = catalogue.entries()
    width = max((len(entry.name) for entry in entries), default=0)
    for entry in entries:
        location = "" if entry.bundled else f"  ({entry.path})"
        out.write(f"{entry.name:{width}}  {entry.description}{location}\n")
    if not entries:
        out.write("no problems found; a path to a module does as well: sysid run PATH\n")
    out.answer(problems=[{**vars(entry), "path": str(entry.path)} for entry in entries])
    return SUCCESS


def _new(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli import new

    module, test = new.write_new_problem(options.name, data=options.data)
    out.wrote(module)
    out.wrote(test)
    out.write(
        f"Try them, then change the steps of {module} into your own:\n"
        f"  sysid show {module}    what is unknown, and what the data determine\n"
        f"  sysid run {module}     identify, and write results/{module.stem}/report.html\n"
        f"  python -m pytest {test}\n"
    )
    return SUCCESS


def _show(options: argparse.Namespace, out: Output) -> int:
    from sysid.cli.show import figures, show

    if read.is_test(options.problem):
        return stored_result.tell(options, out)
    recipe = parameters.recipe_of(options, out, options.seed)
    problem = catalogue.build(recipe)
    if out.json:
        out.answer(**figures(problem, recipe.title))
    else:
        out.write(f"{show(problem, recipe.title)}\n")
    return SUCCESS


def _run(options: argparse.Namespace, out: Output) -> int:
    folder = unfinished.folder_of(options, out)
    with alone_in(folder, "wait for its end" + ", or write elsewhere with --out DIR" * (options.resume is None)):
        return _run_in(folder, options, out)


def _run_in(folder: Path, options: argparse.Namespace, out: Output) -> int:
    start = time.perf_counter()

    def left(least: float) -> float | None:
        """Seconds that are left, at least so many; None without a limit."""
        return None if options.max_time is None else max(options.max_time - (time.perf_counter() - start), least)

    search = unfinished.requested_run(options, folder, out)
    recipe, strategy = search.recipe, unfinished.strategy_of(search)
    problem, files = catalogue.built(recipe, check=False)  # by the search, with its progress and under its clock
    checkpoint = Checkpoint(folder / UNFINISHED, unfinished.with_source(search, files, folder))
    if options.fresh:
        checkpoint.remove()
    test, formulation = problem.measurement, problem.declared
    if search.refine_by is not None and not formulation.refinable:
        raise InputError(
            f"--refine-by {search.refine_by}: the stiffness of this problem has a form of its own, whose frequencies "
            "are not searched apart from it: leave it out"
        )
    out.write(
        f"{recipe.title}: {test.n_sensors} sensors, base moving along {' '.join(test.base_axes or ())}, "
        f"{test.freq.size} lines from {test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz, "
        f"{formulation.size} unknowns, seed {search.seed}\n"
    )
    out.flush()
    failed: InputError | None = None
    # From the search's end until the result is on the disk Ctrl-C waits, however often.
    with DeferredInterrupt(patience=None) as late:
        with display_on(out) as display:
            result = identify(
                problem, strategy=strategy, rng=search.seed, max_time=left(GRACE), progress=display,
                checkpoint=checkpoint,
            )  # fmt: skip
        result = replace(result, recipe=recipe)
        replaced = replaced_in_words(result, folder)
        try:
            save(result, folder, checkpoint)
        except InputError as error:
            failed = error
    try:
        words, figures = summary_and_figures(result, left(GRACE))
        out.write(f"\n{words}\n\n{replaced}")
        out.answer(result=figures)
        if out.quiet and not result.success:
            out.warn(f"no fit: {result.undetermined[0]}")
        out.flush()
        if failed is not None:
            raise failed
        # Raised while matplotlib's objects are collected it would be lost, with a traceback.
        with DeferredInterrupt() as writing:
            write_pages(result, figures, folder, out, left(0.0))
    except KeyboardInterrupt:
        out.complain(f"interrupted while saving; the result is there, but not every file is in {folder}")
        return INTERRUPTED
    if late.asked or writing.asked or result.interrupted:
        on = f"; '{unfinished.resuming_command(search, folder)}' goes on" if checkpoint.exists else ""
        out.complain(f"interrupted; the {'best so far' if result.interrupted else 'result'} is in {folder}{on}")
        return INTERRUPTED
    return SUCCESS if result.judgement in ("determined", "one of many") else NOT_REACHED


def _later(module: str) -> Callable[[argparse.Namespace, Output], int]:
    """The command of a module of this folder, which is imported when it runs."""
    return lambda options, out: int(importlib.import_module(f"sysid.cli.{module}").run(options, out))


def _report(options: argparse.Namespace, out: Output) -> int:
    from sysid.report import report

    source = Path(options.result)
    folder = source if source.is_dir() else source.parent
    # A run would write its result between reading the one there and writing its page.
    with alone_in(folder, "it writes its report itself") if folder.is_dir() else contextlib.nullcontext():
        out.wrote(report.write_report(stored_result.read_result(options, out), folder / report.FILE_NAME))
    return SUCCESS


# -- arguments ----------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="sysid",
        description="Mass, stiffness and damping matrices of a structure from shaker-table tests.",
        epilog=epilog(
            ("sysid run cantilever_tower", "sysid read sine.csv --sensors sensors.toml --out test.h5",
             "sysid run test.h5 --mass 1450", "sysid export results/test test.bdf", "sysid run --help"),
            "Exit status: 0 determined or one of many, 1 doubtful or no fit, 2 a mistake in what was\n"
            "given, 130 interrupted (the best so far is saved), 70 an error of sysid itself.",
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"sysid {__version__}")
    command = adder(parser)

    lister = command("list", summary="list the problems that can be run by name", examples=("sysid list",))
    lister.set_defaults(command=_list)

    new = command(
        "new",
        summary="write a commented problem module and its test here",
        description="Write NAME.py, a commented problem that runs at once, and test_NAME.py; never over a file.",
        examples=("sysid new my_building", "sysid new my_tower --data test.h5"),
    )
    new.add_argument("name", metavar="NAME", help="a name that Python can import: letters, digits, underscores")
    new.add_argument("--data", metavar="TEST.h5", help="a test that 'sysid read' wrote: a module that identifies it")
    new.set_defaults(command=_new)

    show = command(
        "show",
        summary="tell the unknowns of a problem and what its data determine, without a search",
        description="Tell the unknowns of a problem, their bounds and scaling, and what the data determine: rank and "
        "unseen directions of the exact Jacobian at the reference, where it is known, or at a guess. Of a result.h5 "
        "its summary, of a test that 'sysid read' wrote its channels.",
        examples=("sysid show shear_building", "sysid show my_building.py"),
    )
    parameters.add_arguments(show)
    show.add_argument(
        "--seed", type=seed, metavar="N", help="reaches problem() as rng: of simulated noise; 0 by default"
    )
    show.set_defaults(command=_show)

    read.add(command)
    _add_run(command)
    _add_compare(command)
    _add_refine(command)

    report = command(
        "report",
        summary="write report.html again, beside a result",
        examples=("sysid report results/cantilever_tower", "sysid report results/cantilever_tower/result.h5"),
    )
    stored_result.add_result_arguments(report)
    report.set_defaults(command=_report)

    export.add(command)
    doctor.add(command)
    return parser


def _add_run(command: Callable[..., argparse.ArgumentParser]) -> None:
    run = command(
        "run",
        summary="identify the structure of a problem",
        description="Identify the structure of a problem, or of a test that 'sysid read' wrote (sysid run test.h5). "
        "Writes result.h5, summary.json and report.html.",
        examples=(
            "sysid run cantilever_tower",
            "sysid run cantilever_tower --set elements=3 --set noise=0.01 --out results/noisy",
            "sysid run my_building.py --max-time 60 --quiet",
            "sysid run test.h5 --mass 1450",
            "sysid run test.h5 --band 0.5-20",
        ),
    )
    parameters.add_arguments(run, optional=True)
    read.add_options(run)
    run.add_argument(
        "--seed",
        type=seed,
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
    run.add_argument(
        "--refine-by",
        choices=get_args(RefineBy),
        metavar="WAY",
        help="how swarm and hpso-ls give a candidate the measured frequencies: closed-form (swarm by default), the "
        "nearest matrix; ipopt, the paper's nonlinear programme for every candidate, for small problems; leaders "
        "(hpso-ls by default), the closed form, and IPOPT for each new leader of the swarm",
    )
    run.add_argument(
        "--out", metavar="DIR", help="folder of the results, results/NAME by default; one run at a time writes there"
    )
    run.add_argument(
        "--max-time",
        type=seconds,
        metavar="S",
        help="end after about so many seconds; a report that they do not suffice for is left to 'sysid report'",
    )
    run.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the killed or interrupted run in this folder; a PROBLEM that is not bundled is said again",
    )
    trust.add_argument(run, "the unfinished run")
    run.add_argument("--fresh", action="store_true", help="begin anew where there is an unfinished run in the folder")
    run.set_defaults(command=_run)


def _add_compare(command: Callable[..., argparse.ArgumentParser]) -> None:
    compare = command(
        "compare",
        summary="run all strategies on a problem, and other optimisers, side by side",
        description="Run every strategy that applies and, where the extra 'benchmark' is installed, optimisers of "
        "pymoo, cma and SciPy on the objective of the swarm, with its number of evaluations and the same local phase. "
        "Prints one table and writes one picture, comparison.png.",
        examples=("sysid compare shear_building --max-time 1 --out side_by_side",),
    )
    parameters.add_arguments(compare)
    compare.add_argument("--seed", type=seed, default=0, metavar="N", help="of all methods, 0 by default")
    compare.add_argument(
        "--out",
        metavar="DIR",
        help="folder of the picture, results/NAME by default; the table goes there too (CSV, JSON)",
    )
    compare.add_argument("--max-time", type=seconds, metavar="S", help="end each method after about so many seconds")
    compare.set_defaults(command=_later("compare"))


def _add_refine(command: Callable[..., argparse.ArgumentParser]) -> None:
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
    trust.add_module(refine)
    kinds = refine.add_mutually_exclusive_group()
    kinds.add_argument(
        "--starts",
        type=count,
        metavar="N",
        help="16 by default; the first is the result. Tells the distinct minima, and how often each was reached",
    )
    kinds.add_argument(
        "--draws",
        type=functools.partial(whole, 2),
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
        type=band,
        nargs="+",
        metavar="LOW-HIGH",
        help="identify from the lines of each band, in Hz: how far the answer moves with the band",
    )
    kinds.add_argument(
        "--orders",
        type=orders,
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
    refine.add_argument("--workers", type=count, metavar="N", help="processes, as many as processors by default")
    refine.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, such as tcp://host:8786")
    refine.add_argument("--out", metavar="DIR", help="folder, RESULT's folder/refine by default")
    refine.set_defaults(command=_later("refine"))


# -- files --------------------------------------------------------------------------------------


def _write_log() -> str:
    """Write the traceback of the exception at hand; what to tell about it."""
    text = f"sysid {__version__}, Python {sys.version}\n{sys.argv}\n\n{traceback.format_exc()}"
    for folder in (Path(), Path(tempfile.gettempdir())):
        log = folder / _LOG
        with contextlib.suppress(OSError):
            log.write_text(text, encoding="utf-8", errors="backslashreplace")
            return f"the traceback is in {log.absolute()}"
    return "no log file could be written"

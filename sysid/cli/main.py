"""Commands: ``sysid list``, ``new``, ``read``, ``show``, ``run``, ``compare``, ``refine``, ``report``, ``export``.

What they say is words, or with ``--json`` one document, on standard output; progress, warnings and mistakes are on
standard error. Exit status: 0 determined or one of many; 1 doubtful or no fit; 2 a mistake in what was given, told in
one line; 130 interrupted, with the best so far saved; 70 an error of sysid itself, told in one line with the traceback
in a log file.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, NoReturn, cast

from sysid import catalogue
from sysid.cli import requests, starting
from sysid.cli.arguments import JSON, QUIET, command_parser
from sysid.cli.output import (
    Output,
    alone_in,
    collected_warnings,
    display_on,
    keep_for_document,
    replaced_in_words,
    save,
    summary_and_figures,
    write_pages,
    wrong_in_words,
)
from sysid.cli.starting import BUG, INTERRUPTED, MISTAKE, NOT_REACHED, SUCCESS
from sysid.errors import InputError, SolverError
from sysid.identify import identify
from sysid.nlp import GRACE
from sysid.results.checkpoint import FILE_NAME as UNFINISHED
from sysid.results.checkpoint import Checkpoint
from sysid.results.version import __version__
from sysid.search.session import DeferredInterrupt

_LOG = "sysid-error.log"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process where none are given; the exit status."""
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
        options = command_parser().parse_args(argv)
        with collected_warnings() as remarks:
            name = options.command
            run = _HERE.get(name) or importlib.import_module(f"sysid.cli.{name}").run
            status = int(run(options, out))
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


def _run(options: argparse.Namespace, out: Output) -> int:
    folder = requests.folder_of(options, out)
    with alone_in(folder, "wait for its end" + ", or write elsewhere with --out DIR" * (options.resume is None)):
        return _run_in(folder, options, out)


def _run_in(folder: Path, options: argparse.Namespace, out: Output) -> int:
    start = time.perf_counter()

    def left(least: float) -> float | None:
        """Seconds that are left, at least so many; None without a limit."""
        return None if options.max_time is None else max(options.max_time - (time.perf_counter() - start), least)

    search = requests.requested_run(options, folder, out)
    recipe, strategy = search.recipe, requests.strategy_of(search)
    problem, files = catalogue.built(recipe, check=False)  # by the search, with its progress and under its clock
    checkpoint = Checkpoint(folder / UNFINISHED, requests.with_source(search, files, folder))
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
    requests.tell_excited_band(recipe, out)
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
        for wrong in wrong_in_words(result) if out.quiet else ():  # the words tell it
            out.warn(wrong)
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
        on = f"; '{requests.resuming_command(search, folder)}' goes on" if checkpoint.exists else ""
        out.complain(f"interrupted; the {'best so far' if result.interrupted else 'result'} is in {folder}{on}")
        return INTERRUPTED
    return SUCCESS if result.judgement in ("determined", "one of many") else NOT_REACHED


def _report(options: argparse.Namespace, out: Output) -> int:
    from sysid.report import report

    source = Path(options.result)
    folder = source if source.is_dir() else source.parent
    # A run would write its result between reading the one there and writing its page.
    with alone_in(folder, "it writes its report itself") if folder.is_dir() else contextlib.nullcontext():
        out.wrote(report.write_report(requests.read_result(options, out), folder / report.FILE_NAME))
    return SUCCESS


def _export(options: argparse.Namespace, out: Output) -> int:
    from sysid.export import content
    from sysid.export import export as formats

    target = Path(options.file)
    form = formats.format_of(target)  # a wrong ending is told before the result is read
    result = requests.read_result(options, out)
    out.wrote(formats.export(result, target, positive_axes=options.positive_axes, level=options.level))
    without = "" if form.deviations else "; without deviations, which .csv and .mat have"
    precision = formats.precision(target)
    out.write(f"{form.name}; precision: {precision}{without}\n")
    for law in result.structure.laws:
        if options.level is not None and law.is_beyond(options.level):
            low, high = law.levels
            out.warn(
                f"mode {law.mode + 1} was tested from {low:.3g} to {high:.3g} m/s²: at {options.level:g} m/s² its "
                "frequency and damping are extrapolated"
            )
    out.answer(format=form.name, precision=precision, deviations=form.deviations, judgement=result.judgement)
    if result.interrupted or not result.determined:
        out.warn(f"{target.name}: {content.reliability(result)}. Read {form.note}, or report.html")
    return SUCCESS


# Others are the function `run` of the module of their name, which is imported then.
_HERE = {"list": _list, "run": _run, "report": _report, "export": _export}


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

"""Cases of this group, each in a process of its own, with little patience."""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from benchmarks.modal.identification import error_text
from benchmarks.modal.spread import WORKERS
from benchmarks.own_process import figures_of

SLOWER = 10  # by the clock, at most, on a machine with other work


def figures_of_each(module: str, numbers: Iterable[int], patience: int) -> list[dict]:
    """Figures that a module ("band.dashpots") answers by `answer` to each number; why there are none, as "said".

    Parameters
    ----------
    patience : int
        s of processor time a case.
    """

    def figures(number: int) -> dict:
        found = figures_of(f"benchmarks.{module}", [str(number), str(patience)], SLOWER * patience)
        if found.get("said") == "no output":  # as of a process that its system ended
            return {"said": f"not done after {patience} s of processor time"}
        return found

    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(figures, numbers))


def answer(case: Callable[[int], dict]) -> None:
    """Print the figures of the number on the command line as JSON, within the seconds beside it."""
    number, seconds = (int(argument) for argument in sys.argv[1:])
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    try:
        figures = case(number)
    except Exception as error:  # a crash is an answer too: the line counts it as not met
        figures = {"said": error_text(error)}
    print(json.dumps(figures))

"""Process that writes a stored result of a problem, reads one, or times it. A script of its own.

It stands alone, so that the sysid of an earlier commit runs it too: ``python THIS read PATH`` and the like print JSON.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import re
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import sysid
from sysid import catalogue

POINTS = 3  # random ones beside the answer
PATIENCE = 30.0  # s of a search


def results_of(source: Path, searched: bool) -> list:
    """Results of the problem of a module; of a script or page all that it identifies."""
    text = source.read_text(encoding="utf-8")
    if re.search(r"^def problem\(", text, re.MULTILINE):
        problem = catalogue.build(sysid.Recipe(str(source)))
        if searched:
            return [sysid.identify(problem, rng=0, max_time=PATIENCE)]
        x = problem.formulation.guess
        structure = problem.reference or problem.structure(x)
        return [sysid.Identification(structure, problem, x, "none", 0, *_not_searched())]
    found, identify = [], sysid.identify

    def kept(*given, **named):
        found.append(identify(*given, **named))
        return found[-1]

    sysid.identify = kept
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(text, str(source), "exec"), {"__name__": "__main__", "__file__": str(source)})
    return found


def _not_searched() -> tuple:
    """Fields of a result beside its answer where nothing was searched; an earlier commit told them in other fields."""
    if any(field.name == "findings" for field in dataclasses.fields(sysid.Identification)):
        from sysid.finding import Finding, Severity

        return sysid.History(), (Finding("open", Severity.CAUTION, "not searched"),)
    return True, "", sysid.History(), False, (), ("not searched",)


def digests_of_expressions(problem, x) -> list[str]:
    """Of the objective, and of rows and Jacobian of all that is fitted, at an answer and at random points."""
    rng, found = np.random.default_rng(0), []
    points = [x, *(problem.lower + rng.random(x.size) * (problem.upper - problem.lower) for _ in range(POINTS))]
    for point in points:
        digest = hashlib.sha256()
        try:
            digest.update(np.float64(problem.objective(point)).tobytes())
            for term in problem.formulation.terms:
                rows = term.linearised(point, 1.0)
                for part in (rows.residuals, rows.jacobian):
                    digest.update(np.ascontiguousarray(part).tobytes())
        except (np.linalg.LinAlgError, sysid.InputError, ValueError) as error:
            digest.update(type(error).__name__.encode())
        found.append(digest.hexdigest())
    return found


def digests_of_readers(result) -> list[str]:
    """Of summary, figures, page and exported table."""
    from sysid.export.export import export
    from sysid.report.report import write_report

    table, page = Path("table.csv"), Path("page.html")
    export(result, table)
    write_report(result, page)
    lines = table.read_text(encoding="utf-8").splitlines()[1:]  # the first tells the time
    texts = (result.summary(), json.dumps(result.to_dict()), page.read_text(encoding="utf-8"), "\n".join(lines))
    return [hashlib.sha256(text.encode()).hexdigest() for text in texts]


def write(source: str, folder: str, how: str) -> list[dict]:
    """Store all results of a source, "searched" or "guessed"; what was stored, and digests of it."""
    told = []
    for i, result in enumerate(results_of(Path(source), how in ("searched", "own"))):
        path = result.save(Path(folder) / f"{i}.h5")
        searches = result.x is not None and not result.problem.prepared.free_modes
        told.append(
            {
                "path": str(path.absolute()),
                "bytes": path.stat().st_size,
                "expressions": digests_of_expressions(result.problem, result.x) if searches else [],
                "readers": digests_of_readers(result) if how == "own" else [],
            }
        )
    return told


def read(*paths: str) -> list[dict]:
    """The same of stored results, in a process that has seen no problem."""
    told = []
    for path in paths:
        result = sysid.load(path)
        whole = result.part is None
        searches = whole and result.x is not None and not result.problem.prepared.free_modes
        told.append(
            {
                "whole": whole,
                "expressions": digests_of_expressions(result.problem, result.x) if searches else [],
                "readers": [] if whole else digests_of_readers(result),
            }
        )
    return told


def sized(folder: str, *sources: str) -> dict[str, int]:
    """Bytes of the results of some modules, as they are guessed, by the names of their files in the folder."""
    found = {}
    for source in map(Path, sources):
        for result in results_of(source, searched=False):
            path = result.save(Path(folder) / f"{source.stem}.h5")
            found[path.name] = path.stat().st_size
    return found


def timed(folder: str, count: str) -> dict[str, float]:
    """Seconds of a processor that reading each result of a folder takes: the middle one of some loads."""
    found = {}
    for path in sorted(Path(folder).glob("*.h5")):
        taken = []
        for _ in range(int(count) + 1):  # the first imports
            begun = time.process_time()
            sysid.load(path)
            taken.append(time.process_time() - begun)
        found[path.name] = float(np.median(taken[1:]))
    return found


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps({"write": write, "read": read, "size": sized, "time": timed}[sys.argv[1]](*sys.argv[2:])))

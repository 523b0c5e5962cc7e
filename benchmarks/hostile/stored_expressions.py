"""Stored problems without code: what a fresh process reads of them, their size and time, and changed lists."""

from __future__ import annotations

import copy
import io
import json
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.line import Line, below
from benchmarks.problem_modules import ROOT

BEFORE = "47a2c0f"  # the commit in whose files expressions were CasADi's text
SCRIPT = ROOT / "benchmarks" / "hostile" / "own_process_of_a_file.py"
SIZE, SECONDS = 1.2, 1.5  # over those of that commit
MUTATIONS, REDUCED = 2400, 150
REDUCED_MODULES = ("added_mass", "unmeasured_floors")
WITH_DATA = ("recorded_test", "mini_shake_table", "4_real_shake_table")  # their records do not come with the package
LOADS, ROUNDS = 5, 5  # loads a process, and processes of each commit in turn
PATIENCE = 900.0  # s of a process

OWN = '''"""Six sectors in a ring; the stiffness is a class of this module."""

import numpy as np

import sysid


{ring}

def problem(*, data=None, rng=0):
    K = np.kron(np.eye(6), [[4e4]]) + 5e3 * (2 * np.eye(6) - np.roll(np.eye(6), 1, 0) - np.roll(np.eye(6), -1, 0))
    one = np.ones((6, 1))
    whole = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    mass = np.diag([1.0, 1.2, 0.9, 1.1, 1.0, 0.8, 0.0])
    truth = sysid.Structure(mass, whole, np.full(6, 0.01), n_base=1)
    test = sysid.simulate(truth, np.linspace(10, 60, 300), noise=0.01, force=True, rng=rng)
    return sysid.Problem(test, mass=mass, stiffness=RingStiffness())
'''


def lines(reduced: bool) -> Iterator[Line]:
    """Lines of `hostile`; the reduced form takes three problems as they are guessed, and 150 changed lists."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        own = place / "own.py"
        own.write_text(OWN.format(ring=_code("docs/own_unknowns.md", "class RingStiffness")), encoding="utf-8")
        sources = [ROOT / "problems" / f"{name}.py" for name in REDUCED_MODULES] if reduced else _sources(place)
        written = {
            path: _run(place, "write", path, place / f"of_{path.stem}", "guessed" if reduced else "searched")
            for path in sources
        }
        written[own] = _run(place, "write", own, place / "of_own", "own")
        yield from _read_again(place, written, own)
        if not reduced:
            yield from _beside_text(place, sources)
    yield from _changed(REDUCED if reduced else MUTATIONS)


def _sources(place: Path) -> list[Path]:
    """Problem modules of the package, those written from the README, notebooks, and the examples of the pages."""
    folders = (ROOT / "problems", ROOT / "tests" / "modules_from_readme")
    modules = [path for folder in folders for path in sorted(folder.glob("*.py")) if path.stem not in WITH_DATA]
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for i, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)):
            if "import sysid" in code and ("sysid.identify(" in code or "def problem(" in code):
                made = place / f"{page.stem}_{i}.py"
                made.write_text(code, encoding="utf-8")
                modules.append(made)
    return modules + [path for path in sorted((ROOT / "notebooks").glob("*.py")) if path.stem not in WITH_DATA]


def _code(page: str, first: str) -> str:
    """The Python of a page that begins so."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return next(code for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if code.startswith(first))


def _run(place: Path, *arguments: Any, package: Path = ROOT) -> Any:
    """Output of the script in a process of its own, in an empty folder; its last words where it fails."""
    environment = {**os.environ, "PYTHONPATH": str(package), "MPLBACKEND": "Agg"}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    with tempfile.TemporaryDirectory(dir=place) as empty:
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, cwd=empty, env=environment, timeout=PATIENCE
            )
        except subprocess.TimeoutExpired:
            return f"not done after {PATIENCE:g} s"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
    return json.loads(done.stdout.strip().splitlines()[-1])


def _read_again(place: Path, written: dict[Path, Any], own: Path) -> Iterator[Line]:
    """Lines on what a fresh process reads, in an empty folder, where no module is."""
    differing, failed, count, own_alike = list[str](), list[str](), 0, False
    for source, told in written.items():
        if isinstance(told, str):
            failed.append(f"{source.name}: {told[:160]}")
            continue
        again = _run(place, "read", *(one["path"] for one in told)) if told else []
        if isinstance(again, str):
            failed.append(f"{source.name}: {again[:160]}")
            continue
        for mine, other in zip(told, again, strict=True):
            if source == own:
                own_alike = not other["whole"] and mine["readers"] == other["readers"]
                continue
            count += bool(mine["expressions"])
            if not other["whole"] or mine["expressions"] != other["expressions"]:
                differing.append(source.name)
    yield below(f"problems that could not be written or read{_first(failed)}", len(failed), 0)
    yield below(
        f"of {count} problems with a form of their own: not whole, or objective or Jacobian not the same to the bit, "
        f"in a fresh process{_first(differing)}",
        len(differing),
        0,
    )
    told = "the same" if own_alike else "not the same"
    text = "a model's own class, its module absent: summary, figures, page and exported table"
    yield Line(text, told, "the same", own_alike)


def _first(failed: list[str]) -> str:
    return f" (such as {failed[0]})" if failed else ""


def _beside_text(place: Path, sources: list[Path]) -> Iterator[Line]:
    """Lines on bytes and seconds over those of the files that held CasADi's text."""
    done = subprocess.run(["git", "archive", BEFORE, "sysid", "problems"], capture_output=True, cwd=ROOT, check=False)
    if done.returncode:
        yield Line("bytes and seconds over those of files with CasADi's text", "no history here: not run")
        return
    before = place / "before"
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        archive.extractall(before, filter="data")
    modules = [path for path in sources if path.parent.name in ("problems", "modules_from_readme")]
    packages = {"now": ROOT, "then": before}
    sizes = [_run(place, "size", place / name, *modules, package=package) for name, package in packages.items()]
    taken = [
        [_run(place, "time", place / name, LOADS, package=package) for name, package in packages.items()]
        for _ in range(ROUNDS)
    ]
    failed = [one for one in (*sizes, *(one for pair in taken for one in pair)) if isinstance(one, str)]
    if failed:
        yield Line(f"bytes and seconds over those of {BEFORE}", failed[0][:200], "figures of both", False)
        return
    size = {name: sizes[0][name] / sizes[1][name] for name in sizes[0]}
    seconds = {name: float(np.median([now[name] / then[name] for now, then in taken])) for name in size}
    for what, ratios, bound in (("bytes", size, SIZE), ("seconds to load", seconds, SECONDS)):
        worst = max(ratios, key=ratios.__getitem__)
        middle = float(np.median(list(ratios.values())))
        yield below(
            f"{what} over those of {BEFORE}, {len(ratios)} problems: the largest ({worst}; median {middle:.3g})",
            ratios[worst],
            bound,
        )


def _changed(count: int) -> Iterator[Line]:
    """Lines on lists of operations of which some numbers or names were changed, read in a process of their own."""
    command = [sys.executable, "-W", "ignore", "-m", __name__, str(count)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)
    crashed = done.returncode != 0
    said = (done.stderr.strip().splitlines() or ["no output"])[-1][:160] if crashed else ""
    text = f"{count} changed lists of operations: crashes of the process" + f" ({said})" * crashed
    yield below(text, float(crashed), 0)
    if not crashed:
        refused, other, first = json.loads(done.stdout.strip().splitlines()[-1])
        text = f"{count} changed lists, {refused} of them refused: ended in another error than one for people{first}"
        yield below(text, other, 0)


def changed(tree: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A tree of operations with one to three of its numbers, names or kinds changed."""
    from sysid.problem import operations

    tree = copy.deepcopy(tree)
    for _ in range(int(rng.integers(1, 4))):
        function = tree["functions"][rng.integers(len(tree["functions"]))]
        part = ("code", "code", "code", "inputs", "outputs", "numbers", "kind", "names", "patterns")[rng.integers(9)]
        place = tree if part in ("names", "patterns") else function
        if part == "kind":
            function[part] = ("mx", "sx", "map", "switch", "linear", "bspline", "jit", "external")[rng.integers(8)]
        elif part == "names":
            names = [*tree["names"], *operations.NAMES, "solve mumps", "solve ../evil", "external", "\0"]
            tree[part] = tuple(names[rng.integers(len(names))] for _ in tree["names"])
        elif place[part].size:
            values = place[part].astype(float if part == "numbers" else np.int64)
            wild = (-1, 0, 1, 2, 7, 300, 10**6, 2**62, values[rng.integers(values.size)])
            values[rng.integers(values.size)] = wild[rng.integers(len(wild))]
            place[part] = values[: rng.integers(1, values.size + 1)] if rng.random() < 0.1 else values
    return tree


def read_changed(count: int) -> tuple[int, int, str]:
    """Read so many changed lists of bundled problems, and evaluate them; refused ones, other errors, the first."""
    import casadi as ca

    import sysid
    from sysid import catalogue
    from sysid.problem import stored
    from sysid.problem.decoding import decode

    trees, rng, refused, other, first = [], np.random.default_rng(25), 0, 0, ""
    for name in (
        REDUCED_MODULES if count < MUTATIONS else sorted(path.stem for path in (ROOT / "problems").glob("*.py"))
    ):
        if name not in WITH_DATA:
            given = catalogue.build(sysid.Recipe(str(ROOT / "problems" / f"{name}.py"))).to_tree()["given"]
            if given["expressions"] is not None:
                trees.append((given["expressions"], stored.from_tree(given), given["variables"]))
    for k in range(count):
        tree, _, variables = trees[k % len(trees)]
        symbols = [ca.MX.sym(one["name"], *(int(size) for size in one["shape"])) for one in variables]
        try:
            made = decode(changed(tree, rng), symbols)
            ca.Function("read", symbols, made).call([ca.DM.ones(*symbol.shape) for symbol in symbols])
        except sysid.InputError:
            refused += 1
        except Exception as error:  # what this looks for
            other, first = other + 1, first or f" (the first: {k}: {type(error).__name__}: {error})"[:200]
    return refused, other, first


if __name__ == "__main__":
    print(json.dumps(read_changed(int(sys.argv[1]))))

"""The whole way once: a base-shake test in, a structural model out."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.bad_input import CASES, outcome
from benchmarks.line import Line, above, below
from benchmarks.problem_modules import ROOT, load_module
from benchmarks.shake_amplitude import unseen_scores_with_amplitude
from sysid.swarm import SwarmSettings
from sysid.swarm_cost import SwarmCost

SEEDS = range(5)


def lines(reduced: bool, data: Path, only: str) -> Iterator[Line]:
    """All lines, group by group."""
    groups = {
        "tower": lambda: tower(range(1) if reduced else SEEDS),
        "noise": lambda: noise(range(1) if reduced else SEEDS),
        "swarm": lambda: swarm(reduced),
        "spacecraft": lambda: spacecraft(range(1) if reduced else SEEDS),
        "shake": lambda: shake_table(data),
        "input": bad_input,
        "fresh": lambda: iter(()) if reduced else fresh(),
    }
    for name, group in groups.items():
        if only in name:
            yield from group()


def tower(seeds: range) -> Iterator[Line]:
    """cantilever_tower without noise."""
    module = load_module("cantilever_tower")
    problem = module.problem()
    truth = problem.reference.natural_frequencies
    figures = []
    for seed in seeds:
        result = sysid.identify(problem, strategy="swarm", rng=seed)
        s, n = result.structure, result.structure.n
        blocks = (s.mass[:n, :n], s.stiffness[:n, :n])
        figures.append(
            (
                result.residual,
                np.max(np.abs(np.diag(s.rigid_body_mass) / problem.mass.total_mass - 1)),
                np.max(np.abs(s.natural_frequencies / truth - 1)),
                result.history.refinement_error,
                min(np.linalg.eigvalsh(block)[0] / np.linalg.eigvalsh(block)[-1] for block in blocks),
                result.history.wall_time,
                result.success,
            )
        )
    worst = np.array(figures, dtype=float)
    what = f"cantilever_tower, no noise, {len(seeds)} seeds: "
    yield below(what + "largest relative residual", worst[:, 0].max(), 1e-6)
    yield below(what + "largest relative error of the total mass", worst[:, 1].max(), 1e-9)
    yield below(what + "largest relative distance of the final frequencies from the true ones", worst[:, 2].max(), 1e-7)
    yield below(
        what + "largest relative distance of the refined eigenvalues from the given ones", worst[:, 3].max(), 1e-8
    )
    yield Line(
        what + "M_SS and K_SS positive definite (least ratio of extreme eigenvalues)",
        f"{worst[:, 4].min():.3g}", "> 0", bool(worst[:, 4].min() > 0),
    )  # fmt: skip
    yield Line(what + "seconds a run, and successes", f"{worst[:, 5].round(1).tolist()}, {int(worst[:, 6].sum())}")


def noise(seeds: range) -> Iterator[Line]:
    """cantilever_tower with 1 % noise, a new draw each seed."""
    module = load_module("cantilever_tower")
    ratios = []
    for seed in seeds:
        problem = module.problem(noise=0.01, rng=seed)
        result = sysid.identify(problem, strategy="swarm", rng=seed)
        ratios.append(result.residual / problem.measurement.residual(problem.reference))
    worst = max(abs(ratio - 1) for ratio in ratios)
    yield below(
        f"cantilever_tower, 1 % noise, {len(seeds)} draws: |residual / noise floor - 1| (ratios "
        + ", ".join(f"{ratio:.4f}" for ratio in ratios)
        + ")",
        worst,
        0.05,
    )


def swarm(reduced: bool) -> Iterator[Line]:
    """The swarm alone: no gradient step, closed-form refinement."""
    module = load_module("cantilever_tower")
    for elements, bound in ((3, 0.45), (5, 0.70)):
        if reduced and elements == 5:
            continue
        problem = module.problem(elements=elements)
        cost = SwarmCost(problem)
        box = np.column_stack([problem.lower, problem.upper])
        what = f"swarm alone, n = {2 * elements}, D = {problem.n_variables}, 400 iterations"
        costs = _swarm_costs(cost, box, sysid.Swarm().settings)
        yield below(f"{what}: median residual over seeds 0-4 ({_list(costs)})", float(np.median(costs)), bound)
        if not reduced:
            costs = _swarm_costs(cost, box, SwarmSettings())
            yield Line(
                f"{what}, usual constants b1 = 0.3, b2 = 0.2, c1 + c2 <= 4 ({_list(costs)})", f"{np.median(costs):.4g}"
            )


def _swarm_costs(cost: SwarmCost, box: np.ndarray, settings: SwarmSettings) -> list[float]:
    with threadpool_limits(limits=1):
        return [
            sysid.minimize_swarm(cost, box, rng=seed, max_iterations=400, stall_iterations=None, settings=settings).fun
            for seed in SEEDS
        ]


def _list(values: list[float]) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def spacecraft(seeds: range) -> Iterator[Line]:
    """spacecraft_dummy without noise."""
    problem = load_module("spacecraft_dummy").problem()
    results = [sysid.identify(problem, strategy="swarm", rng=seed) for seed in seeds]
    good = sum(r.residual <= 1e-3 for r in results)
    yield above(
        f"spacecraft_dummy, {len(seeds)} seeds: runs with residual <= 1e-3 ("
        + ", ".join(f"{r.residual:.1e}" for r in results)
        + ")",
        good,
        4 if len(seeds) == 5 else len(seeds),
    )
    yield below("spacecraft_dummy: slowest run, s", max(r.history.wall_time for r in results), 600)


def shake_table(data: Path) -> Iterator[Line]:
    """mini_shake_table: fitted on one event, predicting the other."""
    if not data.is_dir():
        yield Line("mini_shake_table", "records absent: not run (give --data)")
        return
    problem = load_module("mini_shake_table").problem(data=str(data))
    result = sysid.identify(problem, strategy="swarm", rng=0)
    given = np.array([3.75, 11.2, 16.6])
    frequencies = result.structure.natural_frequencies
    yield below(
        f"mini_shake_table: largest relative distance of {frequencies.round(3).tolist()} Hz from 3.75, 11.2, 16.6",
        float(np.max(np.abs(frequencies / given - 1))),
        0.02,
    )
    fitted, unseen = problem.measurement, problem.validation[0]
    yield _scores("fitted event, relative X", _score(result.predict(fitted), fitted.relative), (0.79, 0.82, 0.75))
    yield _scores("unseen event, relative X", _score(result.predict(unseen), unseen.relative), (0.38, 0.33, 0.29))
    stretch, how = unseen_scores_with_amplitude(result, data)
    yield _scores(f"stretch, unseen event ({how})", stretch, (0.50, 0.50, 0.50))
    for name, test in (("fitted", fitted), ("unseen", unseen)):
        rigid = test.response - test.relative
        yield _scores(f"{name} event, absolute X", _score(rigid + result.predict(test), test.response))
        yield _scores(f"{name} event, absolute X, floors move with the table", _score(rigid, test.response))


def _score(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    return 1 - np.linalg.norm(predicted - measured, axis=(0, 2)) / np.linalg.norm(measured, axis=(0, 2))


def _scores(text: str, scores: np.ndarray, bounds: tuple[float, ...] = ()) -> Line:
    figure = " / ".join(f"{s:.3f}" for s in scores)
    if not bounds:
        return Line("mini_shake_table: " + text, figure)
    met = all(s >= b for s, b in zip(scores, bounds, strict=True))
    return Line("mini_shake_table: " + text, figure, ">= " + " / ".join(f"{b:g}" for b in bounds), met)


def bad_input() -> Iterator[Line]:
    """Each mistake ends with status 2, one line on stderr, and nothing written."""
    for name, case in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            yield Line(f"bad input: {name}", *outcome(case, Path(folder)))


def fresh() -> Iterator[Line]:
    """The README's two commands in a new virtual environment, from a clean copy of the checkout."""
    with tempfile.TemporaryDirectory() as folder:
        copy, venv = Path(folder) / "checkout", Path(folder) / "venv"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(copy)], check=True)
        subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
        scripts = venv / ("Scripts" if sys.platform == "win32" else "bin")
        python, command = scripts / "python", shutil.which("sysid", path=str(scripts)) or str(scripts / "sysid")
        subprocess.run([python, "-m", "pip", "install", "--quiet", "."], cwd=copy, check=True)
        begun = time.perf_counter()
        status = subprocess.run(
            [command, "run", "cantilever_tower"], cwd=copy, check=False, capture_output=True
        ).returncode
        yield below(
            f"fresh environment: sysid run cantilever_tower, s (status {status})", time.perf_counter() - begun, 120
        )
        subprocess.run([python, "-m", "pip", "install", "--quiet", ".[test]"], cwd=copy, check=True)
        begun = time.perf_counter()
        run = subprocess.run([python, "-m", "pytest", "-q"], cwd=copy, check=False, capture_output=True, text=True)
        last = (run.stdout.strip().splitlines() or ["no output"])[-1]
        yield below(f"fresh environment: pytest, s ({last})", time.perf_counter() - begun, 600)
        yield Line(
            "fresh environment: both end with status 0",
            f"{status}, {run.returncode}",
            "0, 0",
            status == run.returncode == 0,
        )

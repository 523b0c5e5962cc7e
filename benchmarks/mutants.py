"""Small wrong changes of the mathematics, and whether a test notices each of them.

``python -m benchmarks.mutants [IDENTIFIER ...]`` makes each change alone in a copy of the package, runs the tests that
are to notice it against that copy, and prints a line a change and the counts; exit status 1 unless all are noticed.
At the end all tests that failed are run once more without any change.

A change is found by its code, wherever in the package that stands: white space and line breaks do not matter, but it
must occur exactly once. Its tests are found by the names of their files, wherever in ``tests/`` those are.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import search_mutants, stated_mutants
from benchmarks.line import Line
from benchmarks.mutant import Mutant

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, TESTS = ROOT / "sysid", ROOT / "tests"
SECONDS = 900.0  # that the tests of one change may take


@dataclass(frozen=True)
class Result:
    """Outcome of a change.

    Attributes
    ----------
    mutant : Mutant
    verdict : str
        "killed": a test fails; "survived": all tests pass; "not found": its code does not occur exactly once, or a test
        file is missing; "no verdict": the tests could not tell, or the one that fails does so without the change too.
    detail : str
        Where the code stands, or what went wrong.
    seconds : float
    noticed_by : str
        The test that failed, as pytest names it.
    """

    mutant: Mutant
    verdict: str
    detail: str
    seconds: float
    noticed_by: str = ""

    def __str__(self) -> str:
        mutant = self.mutant
        return f"{self.verdict:10s}  {mutant.identifier}  {mutant.idea}  ({self.detail}, {self.seconds:.1f} s)"


# Each of these was once missed by all tests, or noticed by the luck of one seed.
MISSED = (
    Mutant("A07", "refinement by IPOPT starts from a fresh diagonal",
        "triangle_entries(factor) / scale",
        'triangle_entries(np.diag(np.pad(targets, (0, n - targets.size), mode="edge") * 0.9)) / scale',
        "test_spectrum::test_ipopt_starts_from_the_candidates_own_factor"),
    Mutant("A08", "status of the refinement by IPOPT ignored",
        "return answer if answer.error < EXACT else replace(answer, success=False,",
        "return replace(answer, success=True,",
        "test_spectrum::test_success_is_what_ipopt_says_and_the_spectrum_shows"),
    Mutant("B02", "c1 and c2 exchanged in the velocity",
        "self.cognitive * to_personal_best + self.social * to_global_best",
        "self.social * to_personal_best + self.cognitive * to_global_best", "test_moves"),
    Mutant("B05", "one random number a particle, not one a component",
        "to_global_best = self._rng.random(self._positions.shape)",
        "to_global_best = self._rng.random((self._positions.shape[0], 1)) * np.ones(self._positions.shape)",
        "test_moves"),
    Mutant("B10", "accelerations never adapted", "self.cognitive, self.social = adaptation.next_accelerations(",
        "_ = adaptation.next_accelerations(", "test_moves"),
    Mutant("C05", "inflation of a problem in expressions times 1.5",
        "inflation = inflation_of(test, noise_records(test, structure, fitted), fitted, scattered)",
        "inflation = 1.5 * inflation_of(test, noise_records(test, structure, fitted), fitted, scattered)",
        "test_stated_noise"),
    Mutant("C12", "poles of the data that fit better than the model's never told",
        "possible = max(poles.of_accelerations, EXACT)", "possible = np.inf",
        "test_checks::test_a_model_whose_poles_are_not_those_of_the_data_is_told"),
    Mutant("D03", "stated noise ignored in a fit by direct solves",
        "relative_misfit(self.test, motion, weighted=True, shift=self.shift)",
        "relative_misfit(self.test, motion, weighted=False, shift=self.shift)", "test_stated_noise"),
    Mutant("F01", "gain at a complex frequency with a wrong sign", "detuning + shift**2 + 2", "detuning - shift**2 + 2",
        "test_response"),
    Mutant("F04", "other structures that explain the data never told", "if good and all(apart(",
        "if False and all(apart(",
        "test_continuation::test_ends_of_other_starts_that_explain_the_data_as_well_are_alternatives_once_each"),
    Mutant("F05", "refinement of a leader by IPOPT never taken",
        "if of_solved < (1 - ROUND_OFF) * np.fmin(of_closed, cost):", "if False:", "test_refinement"),
    Mutant("F09", "default of the largest velocity 4", "SwarmSettings(inertia_b1=0.8",
        "SwarmSettings(max_velocity=4.0, inertia_b1=0.8", "test_swarm_strategy"),
    Mutant("F10", "default of 2 particles", "n_particles: int | None = None stall_iterations",
        "n_particles: int | None = 2; stall_iterations", "test_swarm_strategy"),
    Mutant("F11", "default of 1 iteration", "max_iterations: int = 150", "max_iterations: int = 1",
        "test_swarm_strategy"),
    Mutant("G01", "r and s one and the same draw", "to_global_best = self._rng.random(self._positions.shape)",
        "to_global_best = np.divide(to_personal_best, self._pbest - self._positions, "
        "out=self._rng.random(self._positions.shape), where=self._pbest != self._positions)",
        "test_moves"),
    Mutant("G02", "inertia without its random number", "inertia_weight(kappa, rng.random(), settings",
        "inertia_weight(kappa, 0.5 + 0 * rng.random(), settings", "test_moves"),
    Mutant("G03", "step of the accelerations always at its upper end",
        "rng.uniform(settings.acceleration_step_lower, settings.acceleration_step_upper)",
        "max(settings.acceleration_step_upper, rng.uniform(settings.acceleration_step_lower, "
        "settings.acceleration_step_upper))",
        "test_moves"),
    Mutant("G04", "state decided without the one before", "adaptation.next_state(factor, self.state)",
        "adaptation.next_state(factor, EvolutionaryState.EXPLORATION)", "test_moves"),
    Mutant("G06", "guides from the whole swarm", "min(math.ceil(self._settings.guide_share * self.n_particles),",
        "min(self.n_particles,", "test_moves"),
    Mutant("H02", "elitist learning in every state",
        "if self.state is EvolutionaryState.CONVERGENCE and self.box.n_free > 0:", "if self.box.n_free > 0:",
        "test_moves"),
    Mutant("H03", "deviations of free matrices never inflated",
        "inflation = inflation_of(test, records, unknowns, scattered)", "inflation = 1.0",
        "test_uncertainty::TestNoiseLevel"),
)  # fmt: skip

NOTICED = (
    Mutant("A01", "exponent of the mass distribution as misprinted in eq. 20", "(4 * (2 * k - c))", "(2 * (2 * k - c))",
        "test_mass_sampling"),
    Mutant("A02", "healing by the trace without its square root", "ca.sqrt(totals[i] / ca.sumsqr(factor[rows, :]))",
        "(totals[i] / ca.sumsqr(factor[rows, :]))", "test_mass"),
    Mutant("A03", "healing by the trace without the base row",
        "[np.flatnonzero(groups == i).tolist() for i in range(d)]",
        "[np.flatnonzero(groups[: geometry.n] == i).tolist() for i in range(d)]", "test_mass"),
    Mutant("A04", "damping matrix by ratios without its factor 2",
        "modal = np.diag(2 * self.damping_ratios * self._omega)",
        "modal = np.diag(self.damping_ratios * self._omega)", "test_damping"),
    Mutant("A05", "ratio of stiffness-proportional damping without 1/2", "y[1] * omega / 2", "y[1] * omega",
        "test_damping"),
    Mutant("A06", "closed form of the refinement with transposed eigenvectors",
        "replace_spectrum(lam, targets))[:, :, None] * psi.swapaxes(1, 2)",
        "replace_spectrum(lam, targets))[:, :, None] * psi",
        "test_spectrum::test_the_closed_form_is_the_nearest_matrix_of_that_spectrum"),
    Mutant("A09", "bound of the stiffness factor at half the highest frequency", "return float(targets[-1])",
        "return float(targets[-1]) / 2", "test_stiffness"),
    Mutant("A10", "cost of the swarm without the measured spectrum", "lam = replace_spectrum(lam, spectrum)",
        "pass", "test_problem"),
    Mutant("A11", "cost of the swarm without coupling to the base", "ca.tril(L).T @ G + coupling,",
        "ca.tril(L).T @ G,", "test_one_source"),
    Mutant("A12", "imaginary part of the modal gain with the wrong sign", "return size * detuning, -size * loss",
        "return size * detuning, size * loss", "test_response"),
    Mutant("A13", "modal gain with zeta in place of 2 zeta", "omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)",
        "omega[:, None] ** 2 - w**2 + 1j * (ratios * omega)", "test_structure"),
    Mutant("A14", "participations without coupling to the base", "B = self.mass[:n, :n] @ G + self.mass[:n, n:]",
        "B = self.mass[:n, :n] @ G", "test_structure"),
    Mutant("B01", "largest velocity not applied",
        "np.clip(velocities, -self._settings.max_velocity, self._settings.max_velocity, out=velocities)", "pass",
        "test_particles"),
    Mutant("B03", "velocity forgotten", "velocities = self.inertia * self._velocities +",
        "velocities = 0.0 * self._velocities +", "test_moves"),
    Mutant("B04", "cognitive term dropped", "+ self.cognitive * to_personal_best + self.social",
        "+ 0.0 * to_personal_best + self.social", "test_moves"),
    Mutant("B06", "evolutionary factor of the worst particle", "evolutionary_factor(distances, self._leader)",
        "evolutionary_factor(distances, int(np.argmax(self._costs)))", "test_moves"),
    Mutant("B07", "directions of exploration and exploitation exchanged", "_S1: (1.0, -1.0), _S2: (0.5, -0.5),",
        "_S1: (0.5, -0.5), _S2: (1.0, -1.0),", "test_adaptation"),
    Mutant("B08", "candidate of elitist learning never accepted", "if cost < self.best_cost:", "if cost < -np.inf:",
        "test_particles"),
    Mutant("B09", "focusing distance to the mean position",
        "focusing_change_rate(self._positions, self._pbest[self._leader])",
        "focusing_change_rate(self._positions, self._positions.mean(axis=0))", "test_particles"),
    Mutant("B11", "elitist learning never narrows", "self.nit / self.horizon, settings", "0.0, settings",
        "test_particles"),
    Mutant("B12", "stall never seen", "return before - now <= tolerance * abs(before)", "return False",
        "test_minimize"),
    Mutant("C01", "deviations times 1.5", "index.split(np.hstack([normals, unseen]))",
        "index.split(np.hstack([1.5 * normals, unseen]))", "test_uncertainty"),
    Mutant("C02", "intervals 1.2 times too wide", "z = float(ndtri((1 + level) / 2))",
        "z = 1.2 * float(ndtri((1 + level) / 2))", "test_uncertainty_ends"),
    Mutant("C03", "level of intervals one-sided", "ndtri((1 + level) / 2)", "ndtri(level)",
        "test_uncertainty_ends"),
    Mutant("C04", "no inflation", "return float(np.sqrt(beyond * line_correlation(error, unknowns)))", "return 1.0",
        "test_uncertainty::TestNoiseLevel"),
    Mutant("C06", "everything that nothing contradicts determined", 'return "one of many" if cautions(every) else',
        'return "determined" if cautions(every) else', "test_honesty"),
    Mutant("C06b", "contradicted fits called determined", 'return "doubtful"', 'return "determined"', "test_checks"),
    Mutant("C06c", "a doubtful fit ends with status 0",
        'return SUCCESS if result.judgement in ("determined", "one of many") else NOT_REACHED',
        "return SUCCESS if result.success else NOT_REACHED", "test_cli_ends"),
    Mutant("C07", "matrices that noise leaves open called determined", "if not largest <= KNOWN:", "if False:",
        "test_certainty"),
    Mutant("C08", "upper ends of the masses 1 % too high", "np.maximum(values[1], at_identity[i, j])",
        "np.maximum(values[1], at_identity[i, j]) * 1.01", "test_intervals"),
    Mutant("C09", "twin sensors never told", "if apart <= most and np.mean(", "if False and np.mean(", "test_checks"),
    Mutant("C10", "a stated mass that the force contradicts never told", "max(0.01, 3 * force_residual_left",
        "max(np.inf, 3 * force_residual_left", "test_checks"),
    Mutant("C11", "sensors that move with the base never told", "in wrong[np.argsort(-size[wrong])][:MOST_OF_A_KIND]:",
        "in wrong[:0]:",
        "test_checks::test_a_sensor_that_moves_with_the_base_beside_its_modes_is_told_by_how_much"),
    Mutant("C13", "stated values that are missed together never told",
        "if np.sum(off**2) > beyond_chance(off.size) and", "if False and",
        "test_checks::TestOneListForEveryProblem::test_priors_are_checked_one_by_one_and_together"),
    Mutant("D01", "status of the local phase ignored", "success = end.status in SOLVED or end.objective <= EXACT",
        "success = True", "test_local::TestControl"),
    Mutant("D02", "a local minimum of the residues never left",
        "if ended.of_accelerations <= FREE * min(possible for _, _, possible in fits):", "if True:", "test_local"),
    Mutant("D04", "weight of a further test ignored",
        "weight = 1.0 if build.replaced else build.noise() / build.noise_of(modal.records)",
        "weight = 1.0", "test_priors::test_tests_count_by_their_noise"),
    Mutant("D05", "half the Gauss-Newton Hessian", "z.hessian(2 * (J.T @ J))",
        "z.hessian(J.T @ J)", "test_variants_forms"),
    Mutant("D06", "modal Hessian by frequencies wrong",
        "by * (2 * (omega**2)[:, None] + loss)", "by * ((omega**2)[:, None] + loss)", "test_modal_program"),
    Mutant("D07", "normal matrix of the modes twice too large", "return inner * alike,", "return 2 * inner * alike,",
        "test_modal_program"),
    Mutant("E01", "stored problem without its goal", 'goal=tree["goal"],', "goal=None,", "test_storage"),
    Mutant("E02", "stored test without the deviation of its force", '"force_std": self.force_std,',
        '"force_std": None,', "test_storage"),
    Mutant("E03", "stored result without its findings", 'findings=tuple(map(Finding.from_tree, tree["findings"])),',
        'findings=(),', "test_storage"),
    Mutant("E04", "stored structure without its recovery", '"recovery": self.recovery, "rigid_body": self.rigid_body,',
        '"recovery": None, "rigid_body": self.rigid_body,', "test_storage"),
    Mutant("E05", "plot with the prediction of another sensor",
        "test.predict(identification.structure)[run, sensor] + test",
        "test.predict(identification.structure)[run, 0] + test", "test_plot"),
    Mutant("E06", "plot with the record of another sensor", "_channel(test, test.response[run, sensor], predicted,",
        "_channel(test, test.response[run, -1], predicted,", "test_plot"),
    Mutant("E07", "residual of absolute accelerations",
        'self.response - np.einsum("sd,rdf->rsf", self.rigid_body, self.base)',
        'self.response - 0 * np.einsum("sd,rdf->rsf", self.rigid_body, self.base)', "test_measurement"),
    Mutant("E08", "residual of the force relative to the prediction",
        "np.linalg.norm(self.predict_force(structure) - self.force) / np.linalg.norm(self.force)",
        "np.linalg.norm(self.predict_force(structure) - self.force) / np.linalg.norm(self.predict_force(structure))",
        "test_measurement"),
    Mutant("E09", "plotted band for unit base motion", "np.sum(band * np.abs(test.base[run]), axis=0)",
        "np.sum(band, axis=0)", "test_plot"),
    Mutant("F02", "candidates that break constraints not penalised",
        "np.where(broken > 0, WORST * (1 + broken), np.minimum(objective, WORST))", "np.minimum(objective, WORST)",
        "test_swarm_objective"),
    Mutant("F03", "success above the goal", "if goal is not None and residual > goal:", "if False:", "test_identify"),
    Mutant("F06", "leaders never refined by IPOPT",
        'if self.refiner and options.refine_by == "leaders" else None', "if False else None", "test_refinement"),
    Mutant("F07", "the first best of the swarm kept",
        "search.x = search.refined(self.objective.unknowns(x))",
        "search.x = search.x if search.x is not None else search.refined(self.objective.unknowns(x))",
        "test_identify"),
    Mutant("F08", "gradient steps of the swarm left out", "improve_every=options.gradient_every,", "improve_every=0,",
        "test_identify"),
    Mutant("G05", "social pull towards the first particle's best",
        "return self._pbest[self._leader]", "return self._pbest[0]",
        "test_moves"),
    Mutant("H01", "deviations of a problem in expressions times 1.5",
        "inflation * (weights * record.std).ravel() / np.sqrt(2)",
        "1.5 * inflation * (weights * record.std).ravel() / np.sqrt(2)", "test_stated_noise"),
    Mutant("H04", "inertia never adapted",
        "self.inertia = adaptation.inertia_weight(kappa, rng.random(), settings.inertia_b1, settings.inertia_b2)",
        "self.inertia = 0.3 + 0 * rng.random()", "test_moves"),
)  # fmt: skip
MUTANTS = (
    *MISSED, *NOTICED, *search_mutants.MISSED, *search_mutants.NOTICED, *stated_mutants.MISSED, *stated_mutants.TRIED
)  # fmt: skip


def lines(reduced: bool) -> Iterator[Line]:
    """One line a change; the reduced form takes those that were once missed."""
    results = []
    for mutant in MISSED + search_mutants.MISSED + stated_mutants.MISSED if reduced else MUTANTS:
        results.append(examine(mutant))
        verdict, detail = results[-1].verdict, results[-1].detail
        yield Line(f"{mutant.identifier}, {mutant.idea}", f"{verdict} ({detail})", "killed", verdict == "killed")
    wrong = [result.mutant.identifier for result in without_changes(results) if result.verdict == "no verdict"]
    told = f"all but those of {', '.join(wrong)}" if wrong else "all"
    yield Line("tests that noticed a change pass without it", told, "all", not wrong)


def run(only: Iterable[str] = ()) -> list[Result]:
    """Examine changes, print a line each as they come and the counts, and give what came of them.

    Parameters
    ----------
    only : iterable of str
        Identifiers; none for all.

    Raises
    ------
    ValueError
        If an identifier is unknown.
    """
    wanted = set(only)
    unknown = wanted - {mutant.identifier for mutant in MUTANTS}
    if unknown:
        known = ", ".join(mutant.identifier for mutant in MUTANTS)
        raise ValueError(f"no mutant is called {', '.join(sorted(unknown))}; give some of {known}")
    results = []
    for mutant in MUTANTS:
        if not wanted or mutant.identifier in wanted:
            results.append(examine(mutant))
            print(results[-1], flush=True)
    first, results = results, without_changes(results)
    print(*(after for before, after in zip(first, results, strict=True) if after is not before), sep="\n", end="")
    verdicts = ("killed", "survived", "not found", "no verdict")
    counts = (f"{sum(result.verdict == verdict for result in results)} {verdict}" for verdict in verdicts)
    print(f"{len(results)} mutants: {', '.join(counts)}")
    return results


def examine(mutant: Mutant) -> Result:
    """Make a change in a copy of the package, and see whether its tests notice it."""
    begun = time.perf_counter()
    places = [(path, match) for path in sorted(PACKAGE.rglob("*.py")) for match in occurrences(mutant.code, path)]
    tests = [test for name in mutant.tests.split() for test in _tests_of(name)]
    if len(places) != 1:
        verdict, detail, noticed_by = "not found", f"its code occurs {len(places)} times", ""
    elif len(tests) < len(mutant.tests.split()):
        verdict, detail, noticed_by = "not found", f"not all files of {mutant.tests} are below {TESTS.name}/", ""
    else:
        ((path, match),) = places
        text = match.string[: match.start()] + mutant.replacement + match.string[match.end() :]
        verdict, detail, noticed_by = _judged(path.relative_to(PACKAGE), text, tests)
    return Result(mutant, verdict, detail, time.perf_counter() - begun, noticed_by)


def without_changes(results: Sequence[Result]) -> list[Result]:
    """The same results, but without a verdict where the test that failed does not pass without the change."""
    tests = sorted({result.noticed_by for result in results if result.noticed_by})
    if not tests:
        return list(results)
    with tempfile.TemporaryDirectory() as place:
        status = _pytest(ROOT, Path(place), *tests, seconds=SECONDS * len(tests))
        failed = set(tests) if status > 1 else _failed(Path(place))
    told = "{}: the test that failed does not pass without the change"
    return [
        replace(result, verdict="no verdict", detail=told.format(result.detail))
        if result.noticed_by in failed else result
        for result in results
    ]  # fmt: skip


def occurrences(code: str, path: Path) -> list[re.Match[str]]:
    """Where code stands in a file, whatever the white space between its words and signs."""
    text, parts = _text(path), re.findall(r"\w+|[^\w\s]", code)
    if not all(part in text for part in parts):  # most files, and far quicker than the expression
        return []
    start, end = (r"\b" if re.match(r"\w", code[at]) else "" for at in (0, -1))
    return list(re.finditer(start + r"\s*".join(map(re.escape, parts)) + end, text))


@functools.cache
def _text(path: Path) -> str:
    """Text of a file, of which each change asks."""
    return path.read_text(encoding="utf-8")


def _tests_of(name: str) -> list[str]:
    """Full names of the test files, or of what they hold, that are called so."""
    file, *inside = name.split("::")
    return ["::".join([str(path), *inside]) for path in sorted(TESTS.rglob(f"{file}.py"))]


def _judged(path: Path, text: str, tests: list[str]) -> tuple[str, str, str]:
    """Verdict and detail of a package in which the file `path` has this text, and the test that failed."""
    try:
        ast.parse(text)
    except SyntaxError as error:
        return "no verdict", f"the change is no Python: {error}", ""
    with tempfile.TemporaryDirectory() as place:
        changed, cache = Path(place) / "changed", Path(place) / "cache"
        shutil.copytree(PACKAGE, changed / PACKAGE.name)
        (changed / PACKAGE.name / path).write_text(text, encoding="utf-8")
        try:
            status = _pytest(changed, cache, "-x", *tests)
        except subprocess.TimeoutExpired:
            return "no verdict", f"{path}: the tests took more than {SECONDS:.0f} s", ""
        if status == 1:
            return "killed", str(path), min(_failed(cache))
    return ("survived", str(path), "") if status == 0 else ("no verdict", f"{path}: pytest ended with {status}", "")


def _failed(cache: Path) -> set[str]:
    """The tests that failed in a run with this cache, as pytest names them."""
    record = cache / "v" / "cache" / "lastfailed"
    return set(json.loads(record.read_text(encoding="utf-8"))) if record.exists() else set()


def _pytest(source: Path, cache: Path, *arguments: str, seconds: float = SECONDS) -> int:
    """Exit status of pytest with the package that stands in `source`."""
    # The checkout comes last, for what tests import beside the package; its own folder is not put first.
    paths = os.pathsep.join([str(source), str(ROOT)])
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-o", f"cache_dir={cache}", *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env=environment | {"MPLBACKEND": "Agg"}, capture_output=True, timeout=seconds, check=False
    )
    return done.returncode


def main() -> int:
    """Exit status: 0, 1 where a change is not noticed, 2 where an identifier is unknown."""
    try:
        results = run(sys.argv[1:])
    except ValueError as error:
        print(f"python -m benchmarks.mutants: {error}", file=sys.stderr)
        return 2
    return 0 if all(result.verdict == "killed" for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())

"""``sysid show``: what it says of a problem agrees with independent derivatives, closed forms and the solver itself."""

import re
import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import catalogue
from sysid.cli import main as cli
from sysid.cli.show import _point, show
from sysid.nlp import NonlinearProgram
from sysid.results.identification import Recipe
from sysid.search import local

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MASSES, SPRINGS, DAMPERS = np.array([4.0, 3.0, 2.0]), np.array([9e3, 7e3, 5e3]), np.array([30.0, 25.0, 20.0])
STRETCH = np.array([[1.0, 0.0, 0.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [0.0, -1.0, 1.0, 0.0]])
FREQ = np.linspace(0.5, 20.0, 60)


def measure(noise=0.0, *, force=False):
    K = STRETCH.T @ np.diag(SPRINGS) @ STRETCH
    C = (STRETCH.T @ np.diag(DAMPERS) @ STRETCH)[:3, :3]
    truth = sysid.Structure(np.diag([*MASSES, 0.0]), K, damping_matrix=C, n_base=1)
    return sysid.simulate(truth, FREQ, noise=noise, force=force, rng=0)


def chain(*, noise=0.0, force=False, constraints=lambda m, k: [], mass=None, stretch=STRETCH, **guesses):
    """Three masses, springs and dampers; all free unless `mass` is given."""
    m = sysid.Variable("m", 3, lower=0.5, upper=9.0, guess=guesses.get("m", MASSES), unit="kg", fixed=mass is not None)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5, guess=guesses.get("k", SPRINGS), log=True, unit="N/m")
    c = sysid.Variable("c", 3, lower=1.0, upper=90.0, guess=guesses.get("c", DAMPERS), unit="N s/m")
    C = stretch[:, :3].T @ ca.diag(c) @ stretch[:, :3]
    return sysid.Problem(
        measure(noise, force=force), mass=ca.diag(m), stiffness=stretch.T @ ca.diag(k) @ stretch, damping=C,
        constraints=constraints(m, k),
    )  # fmt: skip


def differences(problem, x, unit):
    """Jacobian of the real records by central differences of fourth order, in units; each record of norm one."""
    test = problem.measurement

    def records(at):
        structure = problem.structure(at)
        parts = [test.predict(structure).ravel() / np.linalg.norm(test.relative)]
        if test.force is not None:
            parts.append(test.predict_force(structure).ravel() / np.linalg.norm(test.force))
        z = np.concatenate(parts)
        return np.concatenate([z.real, z.imag])

    columns = []
    for j, step in enumerate(unit):
        e = np.zeros(x.size)
        e[j] = h = 2e-4 * step
        near, far = records(x + e) - records(x - e), records(x + 2 * e) - records(x - 2 * e)
        columns.append((8 * near - far) / (12 * h) * step)
    return np.column_stack(columns)


def told(text):
    """Return rank and number of directions, as the text has them."""
    found = re.search(r"the records see (\d+) of the (\d+) directions", text)
    return tuple(map(int, found.groups()))


CASES = {
    "all free": (lambda case: chain(), 8),
    "masses known": (lambda case: chain(mass=MASSES), 6),
    "base force": (lambda case: chain(force=True), 9),
    "full mass": (lambda case: case(np.random.default_rng(1), "rigid_body", n=3, d=1)[1], 2 * 3 + 3 * 3),
    "full mass, two axes": (lambda case: case(np.random.default_rng(2), "trace", n=3, d=2)[1], 2 * 3 + 3 * 4),
    "lumped chain": (
        lambda case: case(np.random.default_rng(3), "lumped", "chain", "proportional", n=3, d=1)[1], 2 + 3 + 2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_rank_condition_and_null_space_are_those_of_finite_differences_and_of_counting(random_case, name):
    make, counted = CASES[name]
    problem = make(random_case)
    text, point = show(problem, name), _point(problem.prepared, problem)
    J = differences(problem, point.x, point.known.unit)
    s = np.linalg.svd(J, compute_uv=False)
    assert told(text) == (counted, problem.n_variables)
    assert np.linalg.matrix_rank(J, tol=1e-6 * s[0]) == counted
    assert s[counted - 1] > 1e3 * (s[counted] if counted < s.size else 0.0)  # no doubt about the count
    assert np.abs(J @ point.known.unseen).max(initial=0.0) < 1e-6 * s[0]
    condition = float(re.search(r"condition\s+number\s+(\S+)", text)[1])
    # One number weighs all lines of a record here, so singular values differ by a factor only.
    assert condition == pytest.approx(s[0] / s[counted - 1], rel=0.01)


def test_the_null_direction_of_a_free_chain_is_the_common_scale():
    text = show(chain(), "chain")
    (step,) = set(re.findall(r"^      m ([+-]1 %), k ([+-]1 %), c ([+-]1 %)$", text, re.M))
    assert len(set(step)) == 1
    assert "along 1 mass, stiffness or damping change" in text
    assert text.count(" open\n") == 3  # no variable is known


def test_a_modal_mass_cone_is_counted_by_what_it_changes():
    problem = catalogue.build(Recipe("cantilever_tower", parameters={"force": False, "noise": 0.0}))
    text = show(problem, "cantilever_tower")
    n, d = 10, 2
    seen = 2 * n + n * (n + d - 1)  # frequencies, ratios, and residues of rank one
    assert told(text) == (seen, 143)
    # n modal masses; M_00 has d(d+1)/2 entries, whose diagonal the totals tie; and the healing undoes d scales.
    words = " ".join(text.split())
    assert "no record sees 13 directions" in words
    assert "along 10 mass, stiffness or damping change; along 1 only mass and coupling of the base change" in words
    assert "along 2 nothing changes, as other values of the unknowns make the same structure there" in words
    assert "the 3 shortest of 13" in words
    assert "all modal masses are open" in words
    assert "At the reference:" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.parametrize("stated", [False, True])
def test_expected_errors_are_the_bound_from_finite_differences(stated):
    problem = chain(mass=MASSES, noise=0.03 if stated else 0.0)
    noise = 0.03 if stated else 0.01
    text, x = show(problem, "chain"), problem.formulation.guess
    J = differences(problem, x, np.abs(x)) * np.linalg.norm(problem.measurement.relative)
    exact = measure().response if stated else problem.measurement.response
    sigma = noise * np.sqrt(np.mean(np.abs(exact) ** 2)) / np.sqrt(2)  # of each real number
    bound = 100 * sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    for name, entries in (("k", bound[:3]), ("c", bound[3:])):
        shown = float(re.search(rf"^  {name} .* (\S+) %$", text, re.M)[1])
        assert shown == pytest.approx(entries.max(), rel=0.01)
    assert ("deviation at the stated noise" in text) is stated
    assert ("deviation at 1 % noise" in text) is not stated
    # The largest variance in units is that of the direction seen least.
    lam, v = np.linalg.eigh(np.linalg.inv(J.T @ J))
    times = float(re.search(r"noise is\s+(\S+)\s+times that", " ".join(text.split()))[1])
    assert times == pytest.approx(100 * sigma * np.sqrt(lam[-1]) * np.abs(v[:, -1]).max(), rel=0.01)


def test_units_are_those_that_the_local_phase_counts_in(monkeypatch):
    problem = chain(mass=MASSES, k=[9e3, 7e3, 1.2e3], c=[30.0, 25.0, 1.0])
    x, units = problem.formulation.guess, {}
    original = NonlinearProgram.variable

    def variable(self, name, start, *bounds):
        at = {v.name: v.guess for v in problem.variables}[name]
        units.setdefault(name, at / start)
        return original(self, name, start, *bounds)

    monkeypatch.setattr(NonlinearProgram, "variable", variable)
    local.solve(problem.prepared, x, max_iterations=1)
    text = show(problem, "chain")
    for name, unit in units.items():
        shown = f"{unit.min():.4g} to {unit.max():.4g}"
        assert re.search(rf"^  {name} .* {re.escape(shown)}  ", text, re.M)


def test_variables_are_told_with_bounds_scale_and_place():
    problem = chain(mass=MASSES)
    text = show(problem, "a/chain.py")
    assert text.startswith("a/chain.py: 3 sensors (sensor 1, sensor 2, sensor 3), base moving along x, 1 run, 60 lines")
    for v in (*problem.formulation.variables, *problem.formulation.fixed):
        (line,) = (line for line in text.splitlines() if line.startswith(f"  {v.name} ") and v.declared in line)
        scale = "fixed" if v.fixed else "log" if v.log else "linear"
        for cell in ("3", v.unit, f"{v.lower[0]:.4g}", f"{v.upper[0]:.4g}", scale):
            assert f" {cell} " in line
    assert re.search(r"^  stiffness +3 +k \(3\)$", text, re.M)
    assert re.search(r"^  damping +3 +c \(3\)$", text, re.M)
    assert not re.search(r"^  mass +\d", text, re.M)  # it is known
    assert "takes 'continuation': the problem is written in unknowns of its own" in text


def test_models_are_told_by_name_and_an_unstated_guess_by_its_place(random_case):
    problem = random_case(np.random.default_rng(3), "lumped", "chain", "proportional", n=3, d=1)[1]
    text = show(problem, "lumped")
    for block, scale, model in (
        ("mass share", "linear", "LumpedMass"), ("spring", "log", "ChainStiffness"),
        ("rayleigh alpha", "linear", "ProportionalDamping"), ("rayleigh beta", "linear", "ProportionalDamping"),
    ):  # fmt: skip
        assert re.search(rf"^  {block} .*\(middle\) +{scale} +{model}$", text, re.M)
    assert re.search(r"^  mass +3 +mass share \(3\)$", text, re.M)


def test_constraints_take_directions_away_at_a_point_that_keeps_them():
    total = MASSES.sum()
    problem = chain(constraints=lambda m, k: [ca.sum1(m) == total, k[1] <= k[0]], m=[8.0, 8.0, 8.0], k=[7e3] * 3)
    text, point = show(problem, "chain"), _point(problem.prepared, problem)
    assert "moved to where the constraints hold" in text
    m, k = point.x[:3], point.x[3:6]
    assert m.sum() == pytest.approx(total, rel=1e-8)
    assert k[1] < k[0]  # an inequality at its bound would take a direction away
    J = differences(problem, point.x, point.known.unit)
    row = np.concatenate([point.known.unit[:3], np.zeros(6)])
    along = np.linalg.svd(row[None])[2][1:].T
    assert told(text) == (8, 8) == (np.linalg.matrix_rank(J @ along, tol=1e-6), along.shape[1])
    assert "2 constraints  6" in text


def test_a_guess_on_a_symmetry_is_called_special():
    # Of two branches that answer alike, mass, spring and damper may move from one to the other.
    branches = np.array([[1.0, 0.0, 0.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0]])
    total = {"constraints": lambda m, k: [ca.sum1(m) == 9.0], "stretch": branches}
    alike = chain(m=[5, 2, 2], k=[9e3, 2e3, 2e3], c=[9.0, 2.0, 2.0], **total)
    text, point = show(alike, "branches"), _point(alike.prepared, alike)
    assert told(text) == (7, 8)
    assert "this point is special" in text
    assert "at another point of the search space the records see 8 directions" in " ".join(text.split())
    J = differences(alike, point.x, point.known.unit)
    shift = np.array([0, 1, -1] * 3) * point.x / point.known.unit
    assert np.abs(J @ shift).max() < 1e-6 * np.abs(J).max()
    apart = show(chain(m=[5, 2, 2], k=[9e3, 2e3, 3e3], c=[9.0, 2.0, 2.0], **total), "branches")
    assert told(apart) == (8, 8)
    assert "special" not in apart


def test_a_guess_without_derivatives_is_passed_over():
    m = sysid.Variable("m", 3, lower=1.0, upper=9.0, guess=4.0)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5)
    problem = sysid.Problem(
        measure(), mass=ca.diag(ca.sqrt(m - 4) + 3), stiffness=STRETCH.T @ ca.diag(k) @ STRETCH,
        damping=sysid.ModalDamping(),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = show(problem, "root")
    assert "At a point of the search space, as the guess makes no structure with derivatives:" in text


def test_a_term_beside_the_records_leaves_the_point_at_the_reference(random_case):
    truth, problem = random_case(np.random.default_rng(1), "rigid_body", n=3, d=1)
    offset = sysid.Variable("offset", lower=0.0, upper=1.0, guess=0.3)
    alone, beside = (
        sysid.Problem(
            problem.measurement, mass=problem.mass, stiffness=problem.stiffness, reference=truth, residuals=residuals
        )
        for residuals in ([], [sysid.Prior(offset, 0.3, std=0.1)])
    )
    rank, count = told(show(alone, "alone"))
    text = show(beside, "beside")
    assert "At the reference:" in text
    assert told(text) == (rank + 1, count + 1)  # the prior sees one more
    assert re.search(r"^  offset +0\.3 .* 33\.3 %$", text, re.M)


def test_springs_of_a_model_stand_at_the_reference_and_written_ones_at_their_guess():
    truth = sysid.Structure(np.diag([*MASSES, 0.0]), STRETCH.T @ np.diag(SPRINGS) @ STRETCH, [0.01] * 3, n_base=1)
    k = sysid.Variable("k", 3, lower=1e3, upper=1e5, log=True)
    for stiffness, where in (
        (sysid.ChainStiffness(1e3, 1e5), "At the reference:"),
        (STRETCH.T @ ca.diag(k) @ STRETCH, "At the guess (the models cannot be inverted to the reference):"),
    ):
        problem = sysid.Problem(
            sysid.simulate(truth, FREQ), mass=np.diag([*MASSES, 0.0]), stiffness=stiffness, reference=truth
        )
        text = show(problem, "chain")
        assert where in text
        assert ("5000 to 9000" in text) is isinstance(stiffness, sysid.ChainStiffness)


def test_spikes_are_taken_out_as_before_a_search_with_hubers_loss():
    """Without the screening the misfit of two spikes hides every mode."""
    stretch = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
    K = stretch.T @ np.diag([2e4, 1.5e4]) @ stretch
    truth = sysid.Structure(np.diag([5.0, 4.0, 0.0]), K, [0.02, 0.03], n_base=1)
    test = sysid.simulate(truth, np.linspace(2, 20, 100), noise=0.01, rng=0)
    spoiled = test.response.copy()
    spoiled[0, [0, 1], [30, 60]] += np.abs(spoiled).max()
    test = replace(test, response=spoiled, response_std=None)
    models = {"mass": sysid.LumpedMass(9.0), "stiffness": sysid.ChainStiffness(1e3, 1e6)}
    texts = [show(sysid.Problem(test, loss=loss, reference=truth, **models), "x") for loss in ("squares", "huber")]
    assert ["can look like a mode" in " ".join(text.split()) for text in texts] == [True, False]


def test_a_problem_that_cannot_be_searched_is_refused():
    with pytest.raises(sysid.InputError, match="no point within the bounds satisfies constraint 1"):
        show(chain(constraints=lambda m, k: [m[0] >= 2 * k[0]]), "chain")


def test_a_reference_that_the_models_cannot_hold_is_not_passed_off_as_the_point(random_case):
    truth, problem = random_case(np.random.default_rng(5), "rigid_body", n=3, d=1)
    lumped = sysid.Problem(problem.measurement, mass=sysid.LumpedMass(), reference=truth)
    assert "At what the models can hold of the reference, which is not all of it:" in show(lumped, "lumped")
    unknown = sysid.Problem(problem.measurement, mass=sysid.FullMass(), stiffness=problem.stiffness)
    assert "At what the modal strategy finds in the data:" in show(unknown, "full")


def test_the_command_prints_it_and_a_mistake_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["show", "shear_building"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    assert told(out) == (7, 8)
    assert re.search(r"^      mass share [+-]1 %$", out, re.M)  # a share of all is a share of none
    for arguments, message in (
        (["nowhere.py"], "cannot be read"), (["shear_building", "--data", "no"], "no such file"),
        (["shear_building", "--seed", "x"], "not a whole number from 0"), ([], "PROBLEM"),
    ):  # fmt: skip
        assert cli.main(["show", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("sysid: ")
        assert message in error
        assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_data_and_seed_reach_the_module(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text(
        "import sysid\n\n\ndef problem(*, data=None, rng=0):\n    raise sysid.InputError(f'got {data} and {rng}')\n"
    )
    assert cli.main(["show", "my.py", "--data", "my.py", "--seed", "5"]) == 2
    assert "got my.py and 5" in capsys.readouterr().err


def test_no_line_is_wider_than_120_columns_whatever_names_are(random_case):
    wide = sysid.Variable("k" * 150, 3, lower=1e3, upper=1e5, unit="N/m" * 30)
    problem = sysid.Problem(
        measure(), mass=np.diag(MASSES), stiffness=STRETCH.T @ ca.diag(wide) @ STRETCH, damping=sysid.ModalDamping()
    )
    assert max(map(len, show(problem, "name " * 50).splitlines())) <= 120

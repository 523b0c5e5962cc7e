"""A kind of data that is not of the package: natural frequencies with their accuracy, from a test without records.

It touches no file of the package: `NaturalFrequencies` stands among the `residuals`, and makes a term of its own.
"""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.finding import Finding, Severity
from sysid.problem.direct_response import Rows

MASSES, SPRINGS = np.array([2.0, 3.0]), np.array([700.0, 3000.0])
TRUE = np.sqrt(SPRINGS / MASSES) / (2 * np.pi)  # Hz: two oscillators apart
FREQ = np.linspace(1.0, 8.0, 90)
ONE = np.ones((2, 1))
pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


class NaturalFrequencies:
    """Measured natural frequencies.

    Parameters
    ----------
    modes : sequence of int
        Which, counted from 0 in ascending order.
    values, std : array_like, Hz
    """

    def __init__(self, modes, values, std):
        self.modes, self.values, self.std = list(modes), np.asarray(values, float), np.asarray(std, float)

    def expressions(self, name):
        """None: it is about the problem's own matrices."""
        return ()

    def term(self, name, build):
        return _FrequencyTerm(name, self, build.problem_matrices(), build.noise())

    def to_tree(self):
        return {"modes": np.array(self.modes), "values": self.values, "std": self.std}

    @classmethod
    def from_tree(cls, tree):
        return cls(tree["modes"].tolist(), tree["values"], tree["std"])


class _FrequencyTerm:
    """Frequencies less the measured ones, in standard deviations, times the noise of a number of the records."""

    def __init__(self, name, given, matrices, weight):
        self.name, self.given, self.matrices, self.weight = name, given, matrices, weight

    def rows(self, x, modes=None):
        omega = self._omega(x) if modes is None else modes.omega
        return self.weight * (omega[self.given.modes] / (2 * np.pi) - self.given.values) / self.given.std

    def _omega(self, x):
        """In closed form for two degrees of freedom."""
        H = self.matrices.function(x)[6]
        middle, half = (H[0, 0] + H[1, 1]) / 2, ca.hypot((H[0, 0] - H[1, 1]) / 2, H[0, 1])
        return ca.sqrt(ca.vertcat(middle - half, middle + half))

    def off(self, x):
        """In standard deviations; NaN where x is no structure."""
        H = self.matrices.numbers(x).mass_normalised
        lam = np.linalg.eigvalsh(H) if np.all(np.isfinite(H)) else np.full(len(H), np.nan)
        with np.errstate(invalid="ignore"):
            return (np.sqrt(lam)[self.given.modes] / (2 * np.pi) - self.given.values) / self.given.std

    def error(self, x):
        return self.weight * float(np.linalg.norm(self.off(x)))

    def squared(self, particles):
        return np.array([self.error(x) ** 2 for x in particles])

    def linearised(self, x, noise, *, as_stated=False):
        """Slopes by ``d(w²) = psi' dH psi``."""
        lam, psi = np.linalg.eigh(self.matrices.numbers(x).mass_normalised)
        symbol = ca.MX.sym("x", x.size)
        H = self.matrices.function(symbol)[6]
        squares = ca.vertcat(*(ca.bilin(H, shape, shape) for shape in map(ca.DM, psi.T[self.given.modes])))
        jacobian = np.asarray(ca.densify(ca.Function("slopes", [symbol], [ca.jacobian(squares, symbol)])(x)))
        scale = self.weight / self.given.std / (2 * np.pi) / (2 * np.sqrt(lam[self.given.modes]))
        count = len(self.given.modes)
        return Rows(self.weight * self.off(x), scale[:, None] * jacobian, np.full(count, self.weight))

    def findings(self, x):
        return [
            Finding("own term", Severity.CONTRADICTS, "a natural frequency is missed", numbers={str(mode + 1): off})
            for mode, off in zip(self.given.modes, self.off(x), strict=True)
            if abs(off) > 4
        ]


def truth(damping="ratios"):
    K = np.diag(SPRINGS)
    whole = np.block([[K, -K @ ONE], [-ONE.T @ K, ONE.T @ K @ ONE]])
    by = {"damping_ratios": [0.02, 0.03]} if damping == "ratios" else {"damping_matrix": np.diag([1.5, 5.0])}
    return sysid.Structure(np.diag([*MASSES, 0]), whole, n_base=1, **by)


def problem(given, *, damping="ratios", sensors=1, noise=0.01, **options):
    """Springs and damping unknown; the record of a single sensor tells nothing of the second oscillator."""
    test = sysid.simulate(truth(damping), FREQ, noise=noise, rng=3)
    seen = np.eye(2)[:sensors]
    test = sysid.Measurement(
        FREQ, test.base, test.response[:, :sensors], rigid_body=seen @ ONE,
        response_std=None if not noise else test.response_std[:, :sensors],
    )  # fmt: skip
    k = sysid.Variable("k", 2, lower=SPRINGS / 3, upper=SPRINGS * 3, log=True)
    if damping == "ratios":
        z = sysid.Variable("z", lower=0.002, upper=0.2)
        damped = ca.vertcat(z, 0.03)
    else:
        c = sysid.Variable("c", lower=0.1, upper=20.0)
        damped = ca.diag(ca.vertcat(c, 5.0))
    where = {} if sensors == 2 else {"recovery": seen, "rigid_body_dofs": ONE}
    return sysid.Problem(
        test, mass=np.diag(MASSES), stiffness=ca.diag(k), damping=damped, residuals=[given] if given else [],
        **where, **options,
    )  # fmt: skip


def run(given, **options):
    strategy = options.pop("strategy", sysid.Continuation(starts=1))
    return sysid.identify(problem(given, **options), rng=0, strategy=strategy)


kinds = pytest.mark.parametrize("damping", ["ratios", "matrix"])


@kinds
def test_it_counts_in_the_objective_like_numbers_of_the_records(damping):
    given = NaturalFrequencies([0, 1], TRUE * [1.01, 0.98], [0.02, 0.05])
    made = problem(given, damping=damping, sensors=2)
    x = made.formulation.guess * [1.1, 0.95, 1.05]
    made_by_x = np.sqrt(x[:2] / MASSES) / (2 * np.pi)
    test, structure = made.measurement, made.structure(x)
    scale = np.linalg.norm(test.relative / test.response_std)
    records = np.linalg.norm((test.predict(structure) - test.relative) / test.response_std) / scale
    off = (made_by_x - TRUE * [1.01, 0.98]) / [0.02, 0.05]
    expected = np.hypot(records, np.linalg.norm(off) / np.sqrt(2) / scale)
    assert made.objective(x) == pytest.approx(expected, rel=1e-9)
    assert made.residual(x) == pytest.approx(test.residual(structure), rel=1e-9)
    (term,) = made.formulation.beside
    np.testing.assert_allclose(term.squared(np.array([x, x])), term.error(x) ** 2)
    # Its slopes are those of sqrt(k / m) / 2 pi.
    rows = term.linearised(x, np.nan)
    expected = np.diag(made_by_x / (2 * x[:2]) / [0.02, 0.05]) * term.weight
    np.testing.assert_allclose(rows.jacobian[:, :2], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(rows.jacobian[:, 2], 0)


def test_it_touches_the_matrices_and_says_so():
    given = NaturalFrequencies([0], TRUE[:1], [0.01])
    test = sysid.simulate(truth(), FREQ)
    stiffness = sysid.SpectralStiffness(TRUE)
    alone, beside = (
        sysid.Problem(test, mass=sysid.FullMass(5.0), stiffness=stiffness, residuals=r).formulation
        for r in ([], [given])
    )
    assert alone.free_modes
    assert alone.refinable
    assert beside.apart == (False,)
    assert not beside.test_alone
    assert not beside.free_modes
    assert not beside.refinable


@kinds
@pytest.mark.parametrize("strategy", [sysid.Continuation(starts=1), sysid.Swarm(max_iterations=40)], ids=["c", "s"])
def test_it_determines_what_no_record_sees(damping, strategy):
    """The second spring, and how well it is known: k = m (2 pi f)², twice the relative accuracy of f."""
    without = run(None, damping=damping)
    assert not without.determined
    assert any("k[1]" in sentence for sentence in without.undetermined)
    f, std = TRUE[1] * 1.02, 0.03
    result = run(NaturalFrequencies([1], [f], [std]), damping=damping, strategy=strategy)
    assert result.determined, result.undetermined
    k = MASSES[1] * (2 * np.pi * f) ** 2
    np.testing.assert_allclose(result.values["k"][1], k, rtol=1e-4)
    np.testing.assert_allclose(result.uncertainty.variables["k"][1], 2 * k * std / f, rtol=1e-3)
    # The first is known from the records, as without it.
    np.testing.assert_allclose(result.values["k"][0], without.values["k"][0], rtol=1e-5)
    np.testing.assert_allclose(result.uncertainty.variables["k"][0], without.uncertainty.variables["k"][0], rtol=1e-3)


@kinds
def test_beside_records_it_is_weighed_by_its_accuracy(damping):
    """A frequency as exact as the records make it: the mean of both, with the deviation of a mean."""
    alone = run(None, damping=damping, sensors=2)
    k, std = alone.values["k"][0], alone.uncertainty.variables["k"][0]
    # Two deviations above what the records say, and twice as exact.
    stated, own = k + 2 * std, std / 2
    f = np.sqrt(stated / MASSES[0]) / (2 * np.pi)
    given = NaturalFrequencies([0], [f], [f * own / (2 * stated)])
    both = run(given, damping=damping, sensors=2)
    mean = (k / std**2 + stated / own**2) / (1 / std**2 + 1 / own**2)
    assert both.values["k"][0] == pytest.approx(mean, abs=0.02 * std)
    expected = (1 / std**2 + 1 / own**2) ** -0.5
    assert both.uncertainty.variables["k"][0] == pytest.approx(expected, rel=0.03)


def test_a_frequency_that_the_records_contradict_is_named():
    result = run(NaturalFrequencies([0], [1.05 * TRUE[0]], [1e-4 * TRUE[0]]), sensors=2)
    assert not result.determined
    far = run(NaturalFrequencies([1], [1.4 * TRUE[1]], [1e-3]), sensors=2, noise=0.001)
    assert [list(one.numbers) for one in far.of_kind("own term")] == [["2"]]


def test_it_is_stored_and_comes_back(tmp_path):
    result = run(NaturalFrequencies([1], TRUE[1:], [0.03]))
    again = sysid.load(result.save(tmp_path))
    (term,) = again.problem.formulation.beside
    assert type(again.problem.residuals[0]) is NaturalFrequencies
    assert term.error(again.x) == pytest.approx(result.problem.formulation.beside[0].error(result.x), rel=1e-12)
    np.testing.assert_allclose(again.uncertainty.variables["k"], result.uncertainty.variables["k"], rtol=1e-9)

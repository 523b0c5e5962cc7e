"""Standard deviations and intervals against dense finite-difference Jacobians and closed forms.

What draws of noise say of them is the benchmark `modal.accuracy`, which CI runs in its reduced form: stated deviations
over the Cramér-Rao bound's, chi-squared of the errors, and in full how many intervals hold the truth.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

import sysid
from sysid import FullMass, Measurement, Problem, SpectralStiffness, Structure
from sysid.assessment.information import Parametrisation, spread, std_of
from sysid.assessment.uncertainty import uncertainty

FREQ = np.linspace(2, 66, 90)
NAMES = (
    "natural_frequencies", "damping_ratios", "mode_shapes", "participation", "effective_masses", "rigid_body_mass",
    "mass", "stiffness", "damping",
)  # fmt: skip


class Dense:
    """The records and all quantities as plain functions of theta, and their Jacobians by central differences."""

    def __init__(self, structure, test, rows_of_T=None):
        self.test, self.s, self.m, self.d = test, structure.n_sensors, structure.n, structure.n_base
        self.upper = np.triu_indices(self.d)
        omega = 2 * np.pi * structure.natural_frequencies
        parts = [
            structure.mode_shapes, structure.participation, np.log(omega), np.log(structure.damping_ratios),
            structure.rigid_body_mass[self.upper],
        ]  # fmt: skip
        self.at = np.concatenate([part.ravel() for part in parts])
        self.T = structure.normal_modes
        self.rows_of_T = range(self.m) if rows_of_T is None else rows_of_T  # the sensor of each; None: it stands still

    def split(self, theta):
        s, m, d = self.s, self.m, self.d
        phi, gamma, log_w, log_z, upper = np.split(theta, np.cumsum([s * m, m * d, m, m]))
        rigid = np.zeros((d, d))
        rigid[self.upper] = upper
        return phi.reshape(s, m), gamma.reshape(m, d), np.exp(log_w), np.exp(log_z), rigid + np.triu(rigid, 1).T

    def spectra(self, theta, freq):
        phi, gamma, omega, zeta, rigid = self.split(theta)
        w = 2 * np.pi * freq
        g = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (zeta * omega)[:, None] * w)
        response = np.einsum("sk,kf,kj->sjf", phi, g, gamma)
        return response, np.einsum("ki,kf,kj->ijf", gamma, g, gamma) + rigid[:, :, None]

    def records(self, theta):
        response, force = self.spectra(theta, self.test.freq)
        parts = [np.einsum("sjf,rjf->rsf", response, self.test.base).ravel()]
        if self.test.force is not None:
            parts.append(np.einsum("ijf,rjf->rif", force, self.test.base).ravel())
        stacked = np.concatenate(parts)
        return np.concatenate([stacked.real, stacked.imag])

    def quantities(self, theta):
        phi, gamma, omega, zeta, rigid = self.split(theta)
        T = np.array([old if row is None else phi[row] for row, old in zip(self.rows_of_T, self.T, strict=True)])
        P = np.linalg.inv(T)
        effective = np.einsum("ki,kj->kij", gamma, gamma)
        M, K, C = ((P.T * diagonal) @ P for diagonal in (np.ones(self.m), omega**2, 2 * zeta * omega))
        return (omega / (2 * np.pi), zeta, phi, gamma, effective, rigid, M, K, C)

    def jacobian(self, function):
        columns = []
        for p, value in enumerate(self.at):
            step = np.zeros(self.at.size)
            step[p] = 1e-6 * max(abs(value), 0.1)
            columns.append((function(self.at + step) - function(self.at - step)) / (2 * step[p]))
        return np.stack(columns, axis=-1)

    def noise(self):
        parts = [self.test.response_std.ravel()] + ([] if self.test.force is None else [self.test.force_std.ravel()])
        return np.tile(np.concatenate(parts), 2) / np.sqrt(2)  # of a real or imaginary part

    def covariance(self, weights=None, tangent=None):
        """Of weighted least squares; on the columns of `tangent` only, where given."""
        J, noise = self.jacobian(self.records), self.noise()
        Z = np.eye(self.at.size) if tangent is None else tangent
        W = (1 / noise if weights is None else weights)[:, None]
        J = J @ Z
        scale = np.maximum(np.linalg.norm(W * J, axis=0), 1e-30)  # what no record shows is left out
        inverse = np.linalg.pinv(W * J / scale, rcond=1e-7) / scale[:, None]
        half = Z @ inverse * (W[:, 0] * noise)
        return half @ half.T

    def stds(self, covariance):
        """Of each quantity, in the order of NAMES."""
        answer = []
        for at in range(len(NAMES)):
            rows = self.jacobian(lambda theta, at=at: self.quantities(theta)[at])
            answer.append(np.sqrt(np.einsum("...p,pq,...q->...", rows, covariance, rows)))
        return dict(zip(NAMES, answer, strict=True))


@pytest.fixture(autouse=True)
def gains_as_stated(monkeypatch):
    """No error of a gain among what is not known, which chance would add in some of these draws."""
    shown = lambda modal, structure: SimpleNamespace(possible=np.zeros(modal.records.n_sensors))  # noqa: E731
    monkeypatch.setattr("sysid.assessment.uncertainty.gain_errors", shown)


def problem_of(structure, test, mass=None, **options):
    s = test.n_sensors
    stiffness = SpectralStiffness(structure.natural_frequencies[:s], max_frequency=500.0)
    return Problem(test, mass=FullMass() if mass is None else mass, stiffness=stiffness, **options)


def shaken(structure, rng, *, force, runs=2, noise=0.01):
    """Runs of random base motion instead of unit ones."""
    base = rng.normal(size=(runs, structure.n_base, FREQ.size)) + 1j * rng.normal(
        size=(runs, structure.n_base, FREQ.size)
    )
    response = np.einsum("sdf,rdf->rsf", structure.transmissibility(FREQ), base)
    push = np.einsum("edf,rdf->ref", structure.base_force(FREQ), base)
    level = lambda record: noise * np.sqrt(np.mean(np.abs(record) ** 2))  # noqa: E731
    return Measurement(
        FREQ, base, response, rigid_body=structure.rigid_body, response_std=level(response),
        force=push if force else None, force_std=level(push) if force else None,
    )  # fmt: skip


def check(u, expected, names=NAMES, rtol=2e-6):
    for name in names:
        np.testing.assert_allclose(
            getattr(u, name), expected[name], rtol=rtol, atol=1e-9 * expected[name].max(), err_msg=name
        )


FREE = tuple(name for name in NAMES if name != "effective_masses")


class TestAgainstTheDenseJacobian:
    @pytest.mark.parametrize("random_base", [False, True])
    @pytest.mark.parametrize(("n", "d"), [(3, 1), (4, 2)])
    def test_with_force_everything_is_known(self, random_structure, n, d, random_base):
        rng = np.random.default_rng(n)
        truth = random_structure(rng, n, d)
        test = (
            shaken(truth, rng, force=True)
            if random_base
            else sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)
        )
        u = uncertainty(problem_of(truth, test).prepared, truth, None)
        dense = Dense(truth, test)
        covariance = dense.covariance()
        expected = dense.stds(covariance)
        check(u, expected, FREE)
        assert u.inflation == 1.0
        # of products of normals: E(xy) has second-order terms too
        at = slice(n * n, n * n + n * d)
        blocks = covariance[at, at].reshape(n, d, n, d)
        for k in range(n):
            own, s = blocks[k, :, k], u.participation[k]
            second = np.outer(s, s) ** 2 + own**2
            np.testing.assert_allclose(
                u.effective_masses[k] ** 2, expected["effective_masses"][k] ** 2 + second, rtol=1e-5
            )
        rows = np.concatenate([np.arange(at.stop, at.stop + 2 * n), np.arange(at.start, at.stop)])
        scale = np.concatenate([truth.natural_frequencies, truth.damping_ratios, np.ones(n * d)])
        wanted = covariance[np.ix_(rows, rows)] * np.outer(scale, scale)
        size = np.sqrt(np.diag(wanted))
        np.testing.assert_allclose(u.covariance / np.outer(size, size), wanted / np.outer(size, size), atol=1e-5)
        assert u.parameters[0] == "frequency 1, Hz" and u.parameters[n] == "damping ratio 1"
        assert u.parameters[2 * n] == "participation 1 x" and len(u.parameters) == len(wanted)

    @pytest.mark.parametrize("random_base", [False, True])
    def test_without_force_only_what_no_modal_mass_changes(self, random_structure, random_base):
        rng = np.random.default_rng(5)
        truth = random_structure(rng, 4, 2)
        test = shaken(truth, rng, force=False) if random_base else sysid.simulate(truth, FREQ, noise=0.01, rng=1)
        u = uncertainty(problem_of(truth, test).prepared, truth, None)
        expected = Dense(truth, test).stds(Dense(truth, test).covariance())
        check(u, expected, ("natural_frequencies", "damping_ratios"))
        for name in set(NAMES) - {"natural_frequencies", "damping_ratios"}:
            assert np.all(np.isnan(getattr(u, name))), name
        assert np.all(np.isnan(u.base_force(FREQ[:3])))
        assert len(u.parameters) == 8 and np.all(np.isfinite(u.covariance))

    @pytest.mark.parametrize("force", [False, True])
    def test_spectra(self, random_structure, force):
        truth = random_structure(np.random.default_rng(6), 3, 2)
        test = sysid.simulate(truth, FREQ, noise=0.01, force=force, rng=1)
        u, dense, lines = (
            uncertainty(problem_of(truth, test).prepared, truth, None),
            Dense(truth, test),
            np.array([3.0, 17.0, 40.0]),
        )
        covariance = dense.covariance()
        for which, got in enumerate((u.transmissibility(lines), u.base_force(lines) if force else None)):
            if got is not None:
                rows = dense.jacobian(lambda theta, which=which: dense.spectra(theta, lines)[which])
                wanted = np.sqrt(np.einsum("...p,pq,...q->...", rows, covariance, rows.conj()).real)
                np.testing.assert_allclose(got, wanted, rtol=1e-5)

    @pytest.mark.parametrize("separable", [True, "in each run", False])
    def test_noise_that_varies(self, random_structure, separable):
        """Weights of a run are one number a sensor times one a line: the noise's own where it is of this kind, else
        geometric means of it, and the covariance is then the sandwich."""
        rng = np.random.default_rng(7)
        truth = random_structure(rng, 3, 2)
        clean = sysid.simulate(truth, FREQ, force=True)
        shape, push = clean.response.shape, clean.force.shape
        std = 0.01 * rng.uniform(0.5, 2, (1, shape[1], 1)) * rng.uniform(0.5, 2, (shape[0], 1, shape[2]))
        force_std = np.full(push, 0.02)
        if separable == "in each run":
            runs = len(clean.base)
            std, force_std = (one * rng.uniform(0.3, 3, (runs, one.shape[1], 1)) for one in (std, force_std))
        if not separable:
            std, force_std = std * rng.uniform(0.3, 3, shape), force_std * rng.uniform(0.3, 3, push)
        test = dataclasses.replace(clean, response_std=std, force_std=force_std)
        u, dense = uncertainty(problem_of(truth, test).prepared, truth, None), Dense(truth, test)
        weights = []
        for part in (std, force_std):
            log = np.log(part)
            of_run = log.mean(axis=(1, 2), keepdims=True)
            fitted = log.mean(axis=2, keepdims=True) + log.mean(axis=1, keepdims=True) - of_run
            weights.append(np.exp(-fitted).ravel())
        expected = dense.stds(dense.covariance(np.tile(np.concatenate(weights), 2)))
        check(u, expected, FREE)
        best = dense.stds(dense.covariance())["stiffness"]
        assert np.all(u.stiffness >= best * (1 - 1e-6))
        assert separable or np.max(u.stiffness / best) > 1.05

    @pytest.mark.parametrize("healing", ["trace", "rigid_body"])
    def test_a_stated_total_is_held(self, random_structure, healing):
        truth = random_structure(np.random.default_rng(8), 3, 2)
        test = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)
        model = FullMass(healing=healing)
        total = model.total(problem_of(truth, test).geometry, truth.mass)
        u = uncertainty(problem_of(truth, test, FullMass(total, healing=healing)).prepared, truth, None)
        dense = Dense(truth, test)
        geometry, G = problem_of(truth, test).geometry, truth.rigid_body

        def totals(theta):
            phi, gamma, _, _, rigid = dense.split(theta)
            if healing == "rigid_body":
                return np.diag(rigid)
            M = np.linalg.inv(phi @ phi.T)
            M_S0 = np.linalg.inv(phi).T @ gamma - M @ G
            M_00 = rigid - G.T @ M @ G - G.T @ M_S0 - M_S0.T @ G
            return np.array([np.diag(M)[geometry.directions[:3] == i].sum() + M_00[i, i] for i in range(2)])

        np.testing.assert_allclose(totals(dense.at), total, rtol=1e-8)
        scale = np.abs(dense.at)
        tangent = scale[:, None] * scipy.linalg.null_space(dense.jacobian(totals) * scale)
        check(u, dense.stds(dense.covariance(tangent=tangent)), FREE, rtol=1e-5)

    def test_proportional_damping_ties_the_ratios(self, random_case):
        truth, problem = random_case(
            np.random.default_rng(9), damping="proportional", n=3, force=True, total=False, noise=0.01
        )
        dense = Dense(truth, problem.measurement)
        omega, z = 2 * np.pi * truth.natural_frequencies, truth.damping_ratios
        beta, alpha = np.linalg.lstsq(np.column_stack([omega / 2, 1 / (2 * omega)]), z, rcond=None)[0]
        unknowns = np.eye(dense.at.size)
        at = 3 * 3 + 3 * 2
        unknowns[at + 3 : at + 6] = 0
        unknowns[at + 3 : at + 6, at : at + 3] = np.diag((beta * omega / 2 - alpha / (2 * omega)) / z)
        unknowns[at + 3 : at + 6, at + 3] = omega / 2 / z
        unknowns[at + 3 : at + 6, at + 4] = 1 / (2 * omega) / z
        tangent = np.delete(unknowns, at + 5, axis=1)
        u = uncertainty(problem.prepared, truth, None)
        check(u, dense.stds(dense.covariance(tangent=tangent)), FREE, rtol=1e-5)


def with_modes(full, keep, sensors, T_rows):
    """The modes `keep` of a structure seen at `sensors`; degrees of freedom at these (by number) or None: modal."""
    phi, gamma = full.mode_shapes[np.ix_(sensors, keep)], full.participation[keep]
    m, G = len(keep), full.rigid_body[sensors]
    modal = iter(np.eye(m))
    T = np.array([next(modal) if row is None else phi[row] for row in T_rows])
    at_dofs = np.array([np.zeros(full.n_base) if row is None else G[row] for row in T_rows])
    P = np.linalg.inv(T)
    M, K = P.T @ P, (P.T * (2 * np.pi * full.natural_frequencies[keep]) ** 2) @ P
    M_S0 = P.T @ gamma - M @ at_dofs
    rigid = full.rigid_body_mass
    M_00 = rigid - at_dofs.T @ M @ at_dofs - at_dofs.T @ M_S0 - M_S0.T @ at_dofs
    K_S0 = -K @ at_dofs
    return Structure(
        np.block([[M, M_S0], [M_S0.T, M_00]]), np.block([[K, K_S0], [K_S0.T, -at_dofs.T @ K_S0]]),
        full.damping_ratios[keep], n_base=full.n_base, recovery=phi @ P, rigid_body=G,
    )  # fmt: skip


class TestOtherSensorsThanModes:
    @pytest.mark.parametrize(
        ("keep", "sensors", "rows"),
        [([0, 2, 3], [0, 1, 2, 3, 4], [4, 0, 2]), ([0, 1, 2, 3, 4], [1, 3, 4], [0, None, 1, 2, None])],
    )
    def test_against_the_dense_jacobian(self, random_structure, keep, sensors, rows):
        """Fewer modes than sensors: sensors chosen as degrees of freedom; more: modal coordinates beside them."""
        full = random_structure(np.random.default_rng(10), 5, 2)
        truth = with_modes(full, keep, sensors, rows)
        test = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)
        u = uncertainty(problem_of(truth, test).prepared, truth, None)
        dense = Dense(truth, test, rows)
        expected = dense.stds(dense.covariance())
        check(u, expected, FREE, rtol=1e-5)
        assert u.transmissibility(FREQ[:2]).shape == (len(sensors), 2, 2)

    def test_coordinates_that_are_not_measured_have_unknown_matrices(self, random_structure):
        full = random_structure(np.random.default_rng(10), 4, 2)
        truth = Structure(
            full.mass, full.stiffness, full.damping_ratios, n_base=2, recovery=0.5 * np.eye(4) + 0.1,
            rigid_body=full.rigid_body,
        )  # fmt: skip
        u = uncertainty(
            problem_of(truth, sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)).prepared, truth, None
        )
        assert np.all(np.isnan(u.mass)) and np.all(np.isfinite(u.mode_shapes)) and np.all(np.isfinite(u.participation))


class TestWhatTheDataDoNotShow:
    def symmetric_pair(self):
        """One base direction and a symmetric pair: the antisymmetric mode does not take part."""
        k, c = 1e4, 3e3
        K_SS = np.array([[k + c, -c], [-c, k + c]])
        G = np.ones((2, 1))
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        return Structure(np.diag([1.0, 1.0, 0.5]), K, [0.01, 0.02], n_base=1)

    def test_a_mode_that_the_base_does_not_move(self):
        truth = self.symmetric_pair()
        u = uncertainty(
            problem_of(truth, sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)).prepared, truth, None
        )
        for name in ("natural_frequencies", "damping_ratios", "participation", "effective_masses"):
            value = getattr(u, name)
            assert np.all(np.isfinite(value[0])) and np.all(np.isnan(value[1])), name
        assert np.all(np.isnan(u.mass)) and np.all(np.isnan(u.stiffness))
        assert np.all(np.isfinite(u.rigid_body_mass)) and np.all(np.isfinite(u.transmissibility(FREQ)))
        # Frequencies and ratios of both modes, and the participation of the first: known where their deviations are.
        stds = np.concatenate([u.natural_frequencies, u.damping_ratios, u.participation[0]])
        np.testing.assert_allclose(np.sqrt(np.diag(u.covariance)), stds, rtol=1e-9)
        assert np.all(np.isnan(u.covariance[[1, 3]]))

    def test_without_force_no_entry_is_known_of_masses_that_nothing_couples(self):
        """Two oscillators, one on either base direction: zeros between them are no knowledge of the matrix."""
        K = np.diag([4e3, 9e3])
        truth = Structure(np.diag([1.0, 2, 0, 0]), np.block([[K, -K], [-K, K]]), [0.01, 0.02], n_base=2)
        u = uncertainty(problem_of(truth, sysid.simulate(truth, FREQ, noise=0.01, rng=1)).prepared, truth, None)
        for matrix in (u.mass, u.stiffness, u.damping):
            assert np.all(np.isnan(matrix))

    def test_one_run_in_one_direction(self, random_structure):
        """Without force the participation across it is open; with force each mode's whole participation shows in it."""
        truth = random_structure(np.random.default_rng(11), 3, 2)
        unit = sysid.simulate(truth, FREQ, force=True)
        mix = lambda record: np.einsum("r,rcf->cf", [0.6, 0.8], record)[None]  # noqa: E731
        test = Measurement(
            FREQ, mix(unit.base), mix(unit.response), rigid_body=truth.rigid_body, force=mix(unit.force),
            response_std=0.01, force_std=0.01,
        )  # fmt: skip
        u = uncertainty(problem_of(truth, test).prepared, truth, None)
        assert np.all(np.isfinite(u.natural_frequencies)) and np.all(np.isfinite(u.mass))
        assert np.all(np.isnan(u.rigid_body_mass))
        blind = dataclasses.replace(test, force=None, force_std=None)
        v = uncertainty(problem_of(truth, blind).prepared, truth, None)
        assert np.all(np.isfinite(v.natural_frequencies)) and np.all(np.isnan(v.transmissibility(FREQ[10:12])))

    def test_too_few_lines(self, random_structure):
        truth = random_structure(np.random.default_rng(12), 4, 1)
        few = np.array([truth.natural_frequencies[0], truth.natural_frequencies[2]])
        test = sysid.simulate(truth, few, force=True)
        u = uncertainty(problem_of(truth, test).prepared, truth, None)
        assert np.isnan(u.inflation) and np.all(np.isnan(u.mass)) and np.all(np.isnan(u.natural_frequencies))
        stated = uncertainty(
            problem_of(truth, dataclasses.replace(test, response_std=0.1, force_std=0.1)).prepared, truth, None
        )
        assert stated.inflation == 1.0 and np.all(np.isnan(stated.mass))

    def test_repeated_frequencies_are_the_limit_of_close_ones(self, random_blocks):
        truths = []
        for apart in (0.0, 2e-4):
            M, K, _ = random_blocks(np.random.default_rng(13), 3, 2, frequencies=[10.0, 10.0 * (1 + apart), 25.0])
            truths.append(Structure(M, K, [0.02, 0.02, 0.01], n_base=2))
        tests = [sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1) for truth in truths]
        one, close = (uncertainty(problem_of(t, test).prepared, t, None) for t, test in zip(truths, tests, strict=True))
        expected = Dense(truths[1], tests[1]).stds(Dense(truths[1], tests[1]).covariance())
        for name in ("mass", "stiffness"):
            np.testing.assert_allclose(getattr(close, name), expected[name], rtol=1e-4)
            np.testing.assert_allclose(getattr(one, name), expected[name], rtol=2e-2)


class TestNoiseLevel:
    def case(self, random_structure, **stated):
        truth = random_structure(np.random.default_rng(18), 4, 2)
        test = sysid.simulate(truth, np.linspace(2, 66, 300), noise=0.01, force=True, rng=3)
        changed = {name: factor and getattr(test, name) * factor for name, factor in stated.items()}
        return uncertainty(problem_of(truth, dataclasses.replace(test, **changed)).prepared, truth, None)

    def test_unstated_it_is_the_misfit(self, random_structure):
        u = self.case(random_structure)
        estimated = self.case(random_structure, response_std=None, force_std=None)
        assert estimated.inflation == 1.0
        for name in NAMES:
            np.testing.assert_allclose(getattr(estimated, name), getattr(u, name), rtol=0.05)

    def test_stated_too_small_it_is_raised(self, random_structure):
        u = self.case(random_structure)
        low = self.case(random_structure, response_std=0.5, force_std=0.5)
        assert low.inflation == pytest.approx(2.0, rel=0.03)
        for name in FREE:
            np.testing.assert_allclose(getattr(low, name), low.inflation / 2 * getattr(u, name), rtol=1e-9)
        high = self.case(random_structure, response_std=2.0, force_std=2.0)
        assert high.inflation == 1.0

    def test_no_noise_at_all(self, random_structure):
        truth = random_structure(np.random.default_rng(18), 4, 2)
        u = uncertainty(problem_of(truth, sysid.simulate(truth, FREQ, force=True)).prepared, truth, None)
        assert np.all(u.natural_frequencies < 1e-10 * truth.natural_frequencies)
        assert np.all(np.isfinite(u.stiffness)) and np.all(u.mass < 1e-9)

    def test_no_damping(self, random_structure):
        """A ratio of zero is known as well as any other."""
        truth = random_structure(np.random.default_rng(18), 3, 1, ratios=[0.0, 0.02, 0.01])
        u = uncertainty(
            problem_of(truth, sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=1)).prepared, truth, None
        )
        assert np.all(u.damping_ratios > 0) and np.all(np.isfinite(u.damping))
        low, high = u.interval("damping_ratios")
        assert low[0] < 0 < high[0] and np.all(low[1:] > 0)


@pytest.mark.parametrize("seed", range(3))
def test_what_records_hardly_see_is_told_from_what_they_do_not_see(seed):
    """Near the round-off of J'J; the reference is the singular values of J."""
    rng, size = np.random.default_rng(seed), 170
    columns, moves = (np.linalg.qr(rng.normal(size=(rows, size)))[0] for rows in (3 * size, size))
    seen = np.append(10.0 ** rng.uniform(-5, 0, size - 2), [1e-7, 0.0])
    J = (columns * seen) @ moves.T
    normals, unseen = spread(J.T @ J, None, Parametrisation(np.eye(size), np.ones(size), np.zeros((size, 0))))
    assert unseen.shape == (size, 1)
    hardly, never = moves[:, -2:].T
    np.testing.assert_allclose(np.linalg.norm(hardly @ normals), 1 / (1e-7 * np.sqrt(2)), rtol=0.1)
    assert np.isnan(std_of(never @ np.hstack([normals, unseen]), normals.shape[1], 1.0))

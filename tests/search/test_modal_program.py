"""The program in modal coordinates: its derivatives against CasADi's own, its gauges, and where it ends."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from sysid import Measurement, Structure
from sysid.measurement.measurement import unit_runs
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.modal_fit import Modes, held_gauge, rank_one, separate_poles
from sysid.modal_analysis.spectra_model import SpectraModel, fit_spectra, weights_at
from sysid.models.expressions import lower_triangle, triangle_entries
from sysid.models.spectrum import SOLVED
from sysid.nlp import OBJECTIVE_SCALE, IterationMonitor, NonlinearProgram
from sysid.search.modal_program import ModalResidual, _derivatives, hessian_of, solve_modes


def modes_of(structure):
    return Modes(
        structure.mode_shapes, structure.participation, 2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios,
    )  # fmt: skip


def trial(rng, structure, *, force=False, general=False, noise=0.0, stated=False, lines=40):
    """A test of `structure`: unit runs, or two more runs than directions, of any motion; noise relative.

    With `stated` deviations, of other lines for the force than for the motion: the harder case; or of channels that
    weigh otherwise in each run.
    """
    f, n, d = structure.natural_frequencies, structure.n_sensors, structure.n_base
    freq = np.geomspace(0.6 * f[0], 1.3 * f[-1], lines)
    normal = lambda *shape: rng.normal(size=shape) + 1j * rng.normal(size=shape)  # noqa: E731
    base = normal(d + 2, d, lines) if general else unit_runs(d, lines)
    response = np.einsum("sdf,rdf->rsf", structure.transmissibility(freq), base)
    pull = np.einsum("edf,rdf->ref", structure.base_force(freq), base)
    response, pull = (r + noise * np.sqrt(np.mean(np.abs(r) ** 2) / 2) * normal(*r.shape) for r in (response, pull))
    runs = [len(base)] * (stated == "by run")
    std, force_std = (rng.uniform(0.3, 3, (*runs, channels, 1)) * rng.uniform(0.3, 3, lines) for channels in (n, d))
    return Measurement(
        freq, base, response, rigid_body=structure.rigid_body, force=pull if force else None,
        response_std=std if stated else None, force_std=force_std if stated and force else None,
    )  # fmt: skip


def relative_spectrum(omega, ratios):
    """Poles as logarithms about given ones."""

    def spectrum(z):
        shift, loss = (z.variable(name, np.zeros(len(omega))) for name in ("frequency", "damping ratio"))
        return ca.DM(omega) * ca.exp(shift), ca.DM(ratios) * ca.exp(loss)

    return spectrum


def graph(test, structure):
    """The error about `structure`, its unknowns free of any gauge, and its derivatives as IPOPT gets them."""
    first, d, z = modes_of(structure), structure.n_base, NonlinearProgram()
    gamma = z.variable("participation", first.gamma)
    omega, ratios = relative_spectrum(first.omega, first.ratios)(z)
    rigid = gamma.T @ gamma
    if test.force is not None:
        root = np.linalg.cholesky(structure.rigid_body_mass - first.gamma.T @ first.gamma)
        factor = lower_triangle(z.variable("base mass", triangle_entries(root)), d)
        rigid = rigid + factor @ factor.T
    weights = weights_at(test, first.omega, first.ratios)
    error, model = (
        ModalResidual(test, weights, gamma, omega, ratios, rigid),
        SpectraModel(test, weights, np.arange(first.omega.size)),
    )
    of_theta = hessian_of(model)
    functions = _derivatives(z, error, of_theta, 0)

    def derivatives(at):
        value, gradient = functions["grad_f"](at, [])
        upper = np.asarray(functions["hess_lag"](at, [], 1.0, []))
        hessian = upper + np.triu(upper, 1).T
        return float(value) / OBJECTIVE_SCALE, np.asarray(gradient).ravel() / OBJECTIVE_SCALE, hessian / OBJECTIVE_SCALE

    def numbers(at, *expressions):
        return [np.asarray(v) for v in ca.Function("numbers", [z.z], list(expressions)).call([at])]

    return SimpleNamespace(
        test=test, z=z.z, start=np.concatenate(z.start), error=error, modes=(gamma, omega, ratios, rigid), model=model,
        derivatives=derivatives, numbers=numbers, of_theta=of_theta, weights=weights,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("d", "force", "general", "stated"),
    [
        (1, False, False, False), (2, False, False, True), (3, False, True, False), (2, False, True, True),
        (1, True, False, True), (2, True, False, False), (2, True, True, True), (3, True, True, False),
        (2, True, True, "by run"), (2, False, False, "by run"), (3, True, False, "by run"),
    ],
)  # fmt: skip
class TestDerivatives:
    """At a point off the truth, with records that it does not answer."""

    @pytest.fixture
    def made(self, random_structure, d, force, general, stated):
        rng = np.random.default_rng(10 * d + force)
        structure = random_structure(rng, n=4, d=d)
        made = graph(trial(rng, structure, force=force, general=general, noise=0.3, stated=stated), structure)
        made.at = made.start * rng.uniform(0.8, 1.2, made.start.size) + 0.05 * rng.normal(size=made.start.size)
        return made

    def test_value_is_the_error_that_the_best_shapes_leave(self, made):
        """The shapes by numpy, sensor by sensor."""
        test = made.test
        gamma, omega, ratios, rigid, phi, value = made.numbers(made.at, *made.modes, made.error.phi, made.error.value)
        w = 2 * np.pi * test.freq
        q = w**2 / (omega**2 - w**2 + 2j * ratios * omega * w) * np.einsum("kd,rdf->rkf", gamma, test.base)
        std = np.ones(test.response.shape) if test.response_std is None else test.response_std
        squared = 0.0
        for s in range(test.n_sensors):
            design = np.moveaxis(q / std[:, [s]], 1, 2).reshape(-1, len(gamma))
            record = (test.relative[:, s] / std[:, s]).ravel()
            stacked, wanted = np.vstack([design.real, design.imag]), np.concatenate([record.real, record.imag])
            answer = np.linalg.lstsq(stacked, wanted, rcond=None)[0]
            np.testing.assert_allclose(phi[s], answer, atol=1e-6 * np.abs(answer).max())
            squared += np.sum((stacked @ answer - wanted) ** 2)
        size = np.sum(np.abs(test.relative / std) ** 2)
        expected = squared / size
        if test.force is not None:
            miss = np.einsum("kd,rkf->rdf", gamma, q) + np.einsum("de,ref->rdf", rigid, test.base) - test.force
            if test.force_std is None:
                expected += np.sum(np.abs(made.weights.force[..., None] * miss) ** 2)
            else:
                expected += np.sum(np.abs(miss / test.force_std) ** 2) / size
        assert value.item() == pytest.approx(expected, rel=1e-9)

    def test_gradient_is_casadis_own(self, made):
        value, gradient = made.numbers(made.at, made.error.value, ca.gradient(made.error.value, made.z))
        got_value, got, _ = made.derivatives(made.at)
        assert got_value == pytest.approx(value.item(), rel=1e-12)
        np.testing.assert_allclose(got, gradient.ravel(), atol=1e-8 * np.abs(gradient).max())

    def test_hessian_is_casadis_own(self, made):
        (expected,) = made.numbers(made.at, ca.hessian(made.error.value, made.z)[0])
        np.testing.assert_allclose(made.derivatives(made.at)[2], expected, atol=1e-8 * np.abs(expected).max())

    def test_normal_matrix_is_that_of_kaufmans_jacobian(self, made, d):
        """Slopes of the motions times the shapes, less what other shapes could answer; the whole slope of the force."""
        theta, q = made.error.theta(), made.error.q
        shapes, values, at = made.numbers(made.at, made.error.phi, q, theta)
        by_z = [made.numbers(made.at, ca.jacobian(what, made.z))[0] for what in (ca.vec(q), theta)]
        # All unknowns move theta alone, as many of them as it has entries.
        slopes = (by_z[0] @ np.linalg.inv(by_z[1])).reshape(*values.shape, -1, order="F")
        expected = 0.0
        for shape, weights in zip(shapes, made.weights.sensors.T, strict=True):
            weight = np.tile(np.repeat(weights, made.test.freq.size), 2)
            onto = np.linalg.qr((values * weight).T)[0]
            J = weight[:, None] * np.einsum("k,kaz->az", shape, slopes)
            J = J - onto @ (onto.T @ J)
            expected = expected + J.T @ J
        if made.test.force is not None:
            (F,) = made.numbers(made.at, ca.jacobian(ca.vec(made.error.force_left), made.z))
            F = F @ np.linalg.inv(by_z[1])
            expected += F.T @ F
        model = made.model
        plain, _ = model.slopes(model.unpack(at.ravel()), model.levels)
        np.testing.assert_allclose(plain.normal, expected, atol=1e-8 * np.abs(expected).max())

    def test_numpys_gradient_and_sum_are_those_of_the_symbolic_residual(self, made):
        model = made.model
        at, by_z, value, gradient = made.numbers(
            made.at, made.error.theta(), ca.jacobian(made.error.theta(), made.z), made.error.value,
            ca.gradient(made.error.value, made.z),
        )  # fmt: skip
        plain, _ = model.slopes(model.unpack(at.ravel()), model.levels)
        assert plain.chi2 == pytest.approx(value.item(), rel=1e-10)
        np.testing.assert_allclose(-2 * plain.gradient @ by_z, gradient.ravel(), atol=1e-8 * np.abs(gradient).max())


@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("force", [False, True])
def test_where_nothing_is_left_the_hessian_is_the_exact_one(random_structure, force, general):
    rng = np.random.default_rng(3)
    structure = random_structure(rng, n=3, d=2)
    made = graph(trial(rng, structure, force=force, general=general), structure)
    value, gradient, hessian = made.derivatives(made.start)
    assert value < 1e-20
    (exact,) = made.numbers(made.start, ca.hessian(made.error.value, made.z)[0])
    size = np.abs(exact).max()
    np.testing.assert_allclose(hessian, exact, atol=1e-6 * size)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-9 * size)


def test_a_force_whose_deviation_is_not_stated_weighs_by_the_noise_that_it_has(random_structure):
    rng = np.random.default_rng(4)
    structure = random_structure(rng, n=4, d=2)
    clean, noisy = (trial(rng, structure, force=True, noise=noise, lines=600) for noise in (0.0, 0.02))
    weights = graph(noisy, structure).weights
    motion, pull = (np.std(getattr(noisy, name) - getattr(clean, name)) for name in ("response", "force"))
    weight = weights.force * np.linalg.norm(noisy.relative)
    np.testing.assert_allclose(weight, motion / pull, rtol=0.05)


def fitted(test, first, *, monitor=None):
    """The estimate from `first`, its base mass from anywhere, and where IPOPT ends from there."""
    unit = np.full(test.n_base, np.linalg.norm(first.gamma) / np.sqrt(first.gamma.size))
    monitor = IterationMonitor(None, None) if monitor is None else monitor
    found = fit_spectra(test, first, np.diag(unit**2), monitor=monitor, max_iterations=100)
    assert found.status == "settled"
    apart, pole = separate_poles(found.modes)
    of_poles = relative_spectrum(found.modes.omega[apart], found.modes.ratios[apart])
    return solve_modes(
        ModalEstimate.of_lines(test), found.modes,
        lambda z: tuple(value[pole.tolist()] for value in of_poles(z)), unit=unit,
        remainder=found.rigid - found.modes.gamma.T @ found.modes.gamma, weights=found.weights, monitor=monitor,
    )  # fmt: skip


def residues(modes):
    return np.einsum("nk,kd->knd", modes.phi, modes.gamma)


def near(rng, modes, by):
    off = lambda value: value * (1 + by * rng.uniform(-1, 1, value.shape))  # noqa: E731
    return Modes(modes.phi, off(modes.gamma), modes.omega * (1 + by * modes.ratios), off(modes.ratios))


class TestFit:
    @pytest.mark.parametrize("general", [False, True])
    @pytest.mark.parametrize("force", [False, True])
    @pytest.mark.parametrize("d", [1, 2, 3])
    def test_from_near_the_truth_it_is_reached_with_quadratic_convergence(self, random_structure, d, force, general):
        """Each last step squares the error; IPOPT may call it an end one step before round-off."""
        rng = np.random.default_rng(d)
        structure = random_structure(rng, n=4, d=d)
        truth, test = modes_of(structure), trial(rng, structure, force=force, general=general, lines=200)
        monitor = IterationMonitor(None, None)
        end = fitted(test, near(rng, truth, 0.2), monitor=monitor)
        assert end.status in SOLVED
        assert end.residual < 1e-9
        assert end.of_accelerations < 1e-10
        assert len(monitor.curve) < 15
        assert monitor.curve[-1] < max(1e-12, 1e4 * monitor.curve[-2] ** 2)
        assert end.bounds == ""
        np.testing.assert_allclose(end.modes.omega, truth.omega, rtol=1e-11)
        np.testing.assert_allclose(end.modes.ratios, truth.ratios, rtol=1e-9)
        whole = residues(truth)
        np.testing.assert_allclose(residues(end.modes), whole, atol=1e-9 * np.abs(whole).max())
        if force:  # it sets the scale of each mode too
            np.testing.assert_allclose(np.abs(end.modes.phi), np.abs(truth.phi), atol=1e-8 * np.abs(truth.phi).max())
            rigid = structure.rigid_body_mass
            np.testing.assert_allclose(end.rigid, rigid, atol=1e-8 * np.abs(rigid).max())

    def test_without_a_force_the_scale_of_each_mode_is_held(self, random_structure):
        rng = np.random.default_rng(7)
        structure = random_structure(rng, n=4, d=2)
        first = modes_of(structure)._replace(gamma=rng.normal(size=(4, 2)))
        # One participation of each mode is held in units of `unit`, the one that was largest.
        unit = np.linalg.norm(first.gamma) / np.sqrt(8)
        end = solve_modes(
            ModalEstimate.of_lines(trial(rng, structure)), first,
            relative_spectrum(first.omega, first.ratios), unit=np.full(2, unit),
            remainder=unit**2 * np.eye(2), monitor=IterationMonitor(None, None),
        )  # fmt: skip
        largest = np.argmax(np.abs(first.gamma), axis=1)
        np.testing.assert_allclose(end.modes.gamma[np.arange(4), largest], unit, rtol=1e-12)

    @pytest.mark.parametrize("force", [False, True])
    def test_noise_is_fitted_to_a_point_without_slope_that_is_better_than_the_truth(self, random_structure, force):
        rng = np.random.default_rng(8)
        structure = random_structure(rng, n=4, d=2)
        test = trial(rng, structure, force=force, noise=0.02, lines=150)
        truth = modes_of(structure)
        end = fitted(test, near(rng, truth, 0.1))
        assert end.status in SOLVED
        made = graph(test, structure)
        # Its own participations and poles, in the ungauged unknowns of `graph`.
        at = [end.modes.gamma.ravel(order="F"), np.log(end.modes.omega / truth.omega)]
        at.append(np.log(end.modes.ratios / truth.ratios))
        if force:
            at.append(triangle_entries(np.linalg.cholesky(end.rigid - end.modes.gamma.T @ end.modes.gamma)))
        # The force's weight is the first poles' to say, so that both graphs have to a percent the same one.
        value, gradient, hessian = made.derivatives(np.concatenate(at))
        assert value < made.derivatives(made.start)[0]
        if not force:
            assert end.residual == pytest.approx(np.sqrt(value), rel=1e-9)
            assert np.abs(gradient).max() < 1e-6 * np.abs(hessian).max() * np.sqrt(value)


def test_the_participation_of_a_mode_that_noise_wants_to_weigh_less_than_nothing_stays_a_number(random_structure):
    """The force sees its square, and nothing where it is small: its logarithm would fall for ever."""
    smallest = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        structure = random_structure(rng, n=4, d=1)
        test, truth = trial(rng, structure, force=True, noise=0.01, lines=150), modes_of(structure)
        more = Modes(
            truth.phi[:, :1], 0.05 * np.ones((1, 1)), np.sqrt(truth.omega[:1] * truth.omega[1:2]), np.array([0.01])
        )
        first = truth.joined(more)
        end = solve_modes(
            ModalEstimate.of_lines(test), first, relative_spectrum(first.omega, first.ratios), unit=np.ones(1),
            remainder=structure.rigid_body_mass - truth.gamma.T @ truth.gamma, monitor=IterationMonitor(None, None),
        )  # fmt: skip
        smallest.append(np.abs(end.modes.gamma[-1, 0]))
    assert min(smallest) == pytest.approx(1e-3, rel=1e-6)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_a_base_without_mass_is_no_trouble_to_a_noisy_force(random_orthogonal, seed, d):
    """Noise wants some of its mass negative; the least that there can be is nothing, and the fit ends there."""
    rng = np.random.default_rng(seed)
    G = np.eye(d)[np.arange(4) % d]
    half = random_orthogonal(rng, 4)
    K = (half * (2 * np.pi * np.array([5.0, 9.0, 14.0, 21.0])) ** 2) @ half.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    structure = Structure(np.diag([*np.ones(4), *np.zeros(d)]), (full + full.T) / 2, np.full(4, 0.01), n_base=d)
    test = trial(rng, structure, force=True, noise=0.005, lines=200)
    monitor = IterationMonitor(None, None)
    end = fitted(test, near(rng, modes_of(structure), 0.05), monitor=monitor)
    assert end.status in SOLVED
    assert len(monitor.curve) < 40
    remainder = np.linalg.eigvalsh(end.rigid - end.modes.gamma.T @ end.modes.gamma)
    assert remainder[0] > -1e-12
    assert remainder[-1] < 0.02


def test_base_mass_between_axes_is_found_from_a_start_without_it(random_structure):
    rng = np.random.default_rng(5)
    structure = random_structure(rng, n=4, d=2, base_mass=2.0)
    test, truth = trial(rng, structure, force=True, lines=100), modes_of(structure)
    remainder = structure.rigid_body_mass - truth.gamma.T @ truth.gamma
    shifted = np.diag(np.diag(remainder))  # no record says so
    end = solve_modes(
        ModalEstimate.of_lines(test), truth, relative_spectrum(truth.omega, truth.ratios), unit=np.ones(2),
        remainder=shifted, monitor=IterationMonitor(None, None),
    )  # fmt: skip
    np.testing.assert_allclose(end.rigid, structure.rigid_body_mass, rtol=1e-6, atol=1e-6 * np.trace(end.rigid))
    assert np.abs(remainder[0, 1]) > 1e-3 * np.trace(remainder)


@pytest.mark.parametrize("d", [1, 3])
def test_a_start_without_base_mass_ends_where_one_with_all_of_it_does(random_structure, d):
    """The remainder keeps the rank that it starts with only while no more of it would leave less of the force."""
    rng = np.random.default_rng(d)
    structure = random_structure(rng, n=4, d=d, base_mass=2.0)
    test, truth = trial(rng, structure, force=True, noise=0.01, lines=150), modes_of(structure)
    modal = ModalEstimate.of_lines(test)
    remainder = structure.rigid_body_mass - truth.gamma.T @ truth.gamma
    ends = [
        solve_modes(
            modal, truth, relative_spectrum(truth.omega, truth.ratios), unit=np.ones(d), remainder=share * remainder,
            monitor=IterationMonitor(None, None),
        )
        for share in (0.0, 1.0)
    ]  # fmt: skip
    assert all(end.status in SOLVED for end in ends)
    assert ends[0].residual == pytest.approx(ends[1].residual, rel=1e-7)
    np.testing.assert_allclose(ends[0].rigid, ends[1].rigid, atol=1e-4 * np.abs(ends[1].rigid).max())
    assert np.linalg.eigvalsh(ends[0].rigid - ends[0].modes.gamma.T @ ends[0].modes.gamma)[0] > 0.1


@pytest.mark.parametrize(("d", "force"), [(1, True), (2, False), (3, True)])
def test_slopes_and_curvatures_by_the_unknowns_of_an_estimate_are_those_of_differences(random_structure, d, force):
    """As many modes as directions share a pole; with a force each one's largest participation is by its logarithm."""
    rng = np.random.default_rng(d)
    structure = random_structure(rng, n=4, d=d)
    test, first = trial(rng, structure, force=force, noise=0.02), modes_of(structure)
    pole = np.maximum(np.arange(4) - d + 1, 0)
    apart = np.unique(pole, return_index=True)[1]
    first = first._replace(omega=first.omega[apart][pole], ratios=first.ratios[apart][pole])
    model = SpectraModel(test, weights_at(test, first.omega[apart], first.ratios[apart]), pole)
    start = model.with_best_shapes(first, structure.rigid_body_mass)
    p = model.in_gauge(start, np.full(d, 0.7), by_size=True)
    assert model.chi2(p, model.levels) == pytest.approx(model.chi2(start, model.levels), rel=1e-9)  # of the same fit
    x = model.pack(p)
    np.testing.assert_allclose(model.pack(model.unpack(x)), x, rtol=1e-14)
    chi2 = lambda at: model.chi2(model.unpack(at), model.levels)  # noqa: E731
    gradient = lambda at: _exact(model, model.unpack(at))[1]  # noqa: E731
    steps = 1e-6 * np.eye(x.size)
    by_differences = np.array([chi2(x + h) - chi2(x - h) for h in steps]) / 2e-6
    curved, slopes = _exact(model, p)
    np.testing.assert_allclose(-2 * slopes, by_differences, atol=1e-5 * np.abs(by_differences).max())
    turned = np.array([gradient(x - h) - gradient(x + h) for h in steps]) / 2e-6
    np.testing.assert_allclose(curved, turned, atol=1e-5 * np.abs(turned).max())


def _exact(model, p):
    """Half the exact Hessian and minus half the gradient by the unknowns, whatever its curvature."""
    plain, curved = model.slopes(p, model.levels)
    joined, bend = model.chain(p.modes.gamma.ravel(), plain.gradient)
    return joined @ curved @ joined.T + bend, joined @ plain.gradient


@pytest.mark.parametrize("d", [1, 2])
def test_a_mode_to_which_the_force_gives_no_mass_is_no_trouble(random_structure, d):
    """Of one mode the force is turned, so that less than no mass would fit it: none is the least that there can be."""
    rng = np.random.default_rng(d)
    structure = random_structure(rng, n=4, d=d)
    truth, test = modes_of(structure), trial(rng, structure, force=True, noise=0.003, lines=200)
    w, one = 2 * np.pi * test.freq, truth.at(np.array([2]))
    g = w**2 / (one.omega**2 - w**2 + 2j * one.ratios * one.omega * w)
    of_one = np.einsum("kd,ke,kf,ref->rdf", one.gamma, one.gamma, g[None], test.base)
    test, monitor = replace(test, force=test.force - 1.05 * of_one), IterationMonitor(None, None)
    end = fitted(test, near(rng, truth, 0.02), monitor=monitor)
    assert end.status in SOLVED and len(monitor.curve) < 60
    mine = int(np.argmin(np.abs(end.modes.omega - one.omega)))
    assert np.sum(end.modes.gamma[mine] ** 2) < 1e-6 * np.sum(one.gamma**2)
    whole = residues(truth)
    np.testing.assert_allclose(residues(end.modes), whole, atol=0.02 * np.abs(whole).max())


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_modes_that_share_a_pole_are_fitted_in_a_gauge_of_their_own(random_structure, d, force, noise):
    """Their mixtures are open: in any without a force, by rotations with one. The sum of their residues is known."""
    rng = np.random.default_rng(d)
    other = random_structure(rng, n=5, d=d)
    n, G = other.n, other.rigid_body
    ratios = other.damping_ratios.copy()
    ratios[2] = ratios[1]
    omega = 2 * np.pi * other.natural_frequencies
    omega[2] = omega[1]
    momentum = other.mass[:n, :n] @ other.normal_modes
    K = (momentum * omega**2) @ momentum.T
    full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    structure = Structure(other.mass, (full + full.T) / 2, ratios, n_base=d)
    truth, test = modes_of(structure), trial(rng, structure, force=force, noise=noise, lines=200)
    pole, apart = [0, 1, 1, 2, 3], [0, 1, 3, 4]

    # Poles that are one must be so to the last bit in the start too.
    first = near(rng, truth, 0.2)._replace(omega=(omega[apart] * (1 + 0.1 * ratios[apart]))[pole])
    first = first._replace(ratios=(1.1 * ratios[apart])[pole])
    end = fitted(test, first)
    assert end.status in SOLVED
    summed, whole = ([r[0], r[1] + r[2], r[3], r[4]] for r in (residues(end.modes), residues(truth)))
    if noise == 0:
        # Within IPOPT's tolerance, in squares: how far below it the last step ends differs between machines.
        assert end.residual < 1e-9
        np.testing.assert_allclose(summed, whole, atol=1e-8 * np.abs(whole).max())
        if force:
            block = truth.gamma[1:3].T @ truth.gamma[1:3]
            np.testing.assert_allclose(
                end.modes.gamma[1:3].T @ end.modes.gamma[1:3], block, atol=1e-7 * np.abs(block).max()
            )
    else:
        assert end.residual < 2 * noise * np.linalg.norm(test.response) / np.linalg.norm(test.relative)


def test_modes_that_share_a_pole_start_turned_into_each_other_where_a_force_weighs_them():
    """The turn leaves their share of the rigid-body mass; what it makes zero is held there.

    Of three modes: the turn of two is a reflection, which is its own inverse.
    """
    rng = np.random.default_rng(0)
    first = Modes(np.eye(4), rng.normal(size=(4, 3)), np.array([5.0, 9.0, 9.0, 9.0]), np.full(4, 0.01))
    unit = np.array([1.0, 2.0, 4.0])
    gauge, held = held_gauge(first, unit, True)
    np.testing.assert_allclose(gauge[0], first.gamma[0] / unit, rtol=1e-12)
    before = first.gamma[1:] / unit
    np.testing.assert_allclose(gauge[1:].T @ gauge[1:], before.T @ before, atol=1e-12)
    assert held.sum(axis=1).tolist() == [0, 0, 1, 2]
    np.testing.assert_array_equal(gauge[held], 0.0)


@pytest.mark.parametrize("weighed", [False, True])
def test_more_modes_at_a_pole_than_directions_are_held_in_blocks(weighed):
    """As where a guess has them all at one: five modes, two directions."""
    gamma = np.random.default_rng(0).normal(size=(5, 2))
    gauge, held = held_gauge(Modes(np.eye(5), gamma, np.full(5, 9.0), np.full(5, 0.01)), np.ones(2), weighed)
    for block in (slice(0, 2), slice(2, 4), slice(4, 5)):
        alone = Modes(np.eye(5)[:, block], gamma[block], np.full(5, 9.0)[block], np.full(5, 0.01)[block])
        expected, where = held_gauge(alone, np.ones(2), weighed)
        np.testing.assert_allclose(gauge[block], expected, atol=1e-12)
        np.testing.assert_array_equal(held[block], where)


def test_residues_of_rank_one_are_split_into_shapes_of_any_size():
    rng = np.random.default_rng(0)
    phi, gamma, size = rng.normal(size=(4, 3)), rng.normal(size=(3, 2)), rng.uniform(0.1, 9, 3)
    whole = np.einsum("nk,kd->knd", phi, gamma)
    modes = rank_one(whole, np.arange(1.0, 4), np.full(3, 0.01), size)
    np.testing.assert_allclose(residues(modes), whole, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(modes.phi, axis=0), size)
    # Of any rank: the nearest.
    any_rank = rng.normal(size=(1, 4, 3))
    modes = rank_one(any_rank, np.ones(1), np.ones(1), np.ones(1))
    assert np.linalg.norm(residues(modes) - any_rank) == pytest.approx(
        np.linalg.norm(np.linalg.svd(any_rank[0], compute_uv=False)[1:])
    )

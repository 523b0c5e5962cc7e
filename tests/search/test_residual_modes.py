"""Searches with free modes on structures with modes beyond the lines: derivatives, objectives, and what they find."""

import numpy as np
import pytest

import sysid
from sysid.modal_analysis.response import weighted_error
from sysid.models.expressions import triangle_entries
from sysid.search.inverse_factor_coordinates import InverseFactorError, _residual_of, coordinates_of
from sysid.search.swarm_objective import SwarmObjective

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
OWN = np.array([2.0, 4.5, 7.0])  # Hz
FREQ = np.unique(np.concatenate([np.linspace(1.0, 8.5, 60), *(f * (1 + 0.02 * np.linspace(-2, 2, 9)) for f in OWN)]))


def truth(d=1, above=9.6):
    """Three modes in the lines and two above, at three sensors; all of it on a heavy base."""
    rng = np.random.default_rng(6)
    G = np.eye(d)[np.arange(3) % d]
    phi = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ np.diag([0.5, 0.6, 0.55])
    gamma = rng.normal(size=(3, d)) + 1.0
    P = np.linalg.inv(phi)
    M, K = P.T @ P, (P.T * (2 * np.pi * OWN) ** 2) @ P
    M_S0 = P.T @ gamma - M @ G
    delta = gamma - P @ G
    K_S0 = -K @ G
    own = sysid.Structure(
        np.block([[M, M_S0], [M_S0.T, delta.T @ delta + 20 * np.eye(d)]]),
        np.block([[K, K_S0], [K_S0.T, -G.T @ K_S0]]),
        [0.01, 0.012, 0.015],
        n_base=d,
    )
    beyond = sysid.ResidualModes(
        np.array([above, 14.0]), np.array([0.01, 0.02]), rng.normal(size=(3, 2)) * 0.4, rng.normal(size=(2, d)) + 1.0
    )
    return own.with_residual(beyond)


def measured(structure, *, force=False, noise=0.01, seed=0):
    """Runs with unit base motion, one an axis, whose noise is the same in each."""
    rng, d = np.random.default_rng(seed), structure.n_base
    u = np.tile(np.eye(d)[:, :, None], FREQ.size).astype(complex)
    given = {}
    for name, transfer in (("response", structure.transmissibility(FREQ)), ("force", structure.base_force(FREQ))):
        clean = np.moveaxis(transfer, 1, 0)
        std = noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=(0, 2), keepdims=True)) * np.ones(FREQ.size)
        error = rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)
        given[name], given[name + "_std"] = clean + std * error / np.sqrt(2), std
    if not force:
        del given["force"], given["force_std"]
    return sysid.Measurement(FREQ, u, given.pop("response"), rigid_body=structure.rigid_body, **given)


def problem(structure, **records):
    total = np.diag(structure.rigid_body_mass)
    return sysid.Problem(measured(structure, **records), mass=sysid.FullMass(total, healing="rigid_body"))


def column_of(made, structure, error):
    """Coordinates of the published local phase, and Psi_0."""
    at = coordinates_of(structure)
    of_mass = [triangle_entries(at.inverse), at.loads.ravel(order="F")]
    of_mass += [triangle_entries(at.base)] if made.measurement.force is not None else []
    poles = np.log([2 * np.pi * structure.natural_frequencies, structure.damping_ratios]).ravel()
    return np.concatenate([*of_mass, np.zeros(3), *_residual_of(structure, error), poles]), at.psi


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("d", [1, 2])
def test_the_published_local_phase_has_residual_modes_with_exact_derivatives(d, force):
    made = problem(truth(d), force=force)
    x = np.clip(1.02 * made.values(truth(d)), made.lower, made.upper)
    structure, error = made.structure(x), InverseFactorError(made.prepared)
    assert structure.residual.count
    y, psi = column_of(made, structure, error)
    left = weighted_error(made.measurement, structure)
    assert float(error.value(y, psi)) == pytest.approx(left**2, rel=1e-6)
    rng, h = np.random.default_rng(0), 1e-5
    along = rng.standard_normal(y.size) * np.maximum(np.abs(y), 0.1)
    steps = [error.gradient(y + k * h * along, psi) for k in (-2, -1, 1, 2)]
    values, slopes = ([np.asarray(step[i]).ravel() for step in steps] for i in (0, 1))
    gradient, hessian = np.asarray(error.gradient(y, psi)[1]).ravel(), np.asarray(error.hessian(y, psi))
    by_differences = [(v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * h) for v in (values, slopes)]
    assert by_differences[0].item() == pytest.approx(gradient @ along, rel=1e-6)
    assert np.linalg.norm(by_differences[1] - hessian @ along) < 1e-6 * np.linalg.norm(hessian @ along)


@pytest.mark.parametrize("force", [False, True])
def test_the_objective_without_lines_leaves_out_what_residual_modes_explain(force):
    made = problem(truth(), force=force)
    objective = SwarmObjective(made.prepared, spectrum=made.formulation.stiffness.spectrum)
    assert objective._held is not None
    assert made.formulation.matrices.beyond.omega.size
    low, high = made.formulation.box
    rows = np.random.default_rng(0).uniform(low, high, (40, made.n_variables))
    np.testing.assert_allclose(objective(rows) ** 2, objective._by_lines(rows), rtol=1e-8)


def test_a_force_in_two_directions_goes_by_lines():
    made = problem(truth(2), force=True)
    assert SwarmObjective(made.prepared, spectrum=made.formulation.stiffness.spectrum)._held is None


@pytest.mark.parametrize(("strategy", "force"), [("swarm", False), ("swarm", True), ("hpso-ls", True)])
def test_searches_fit_to_the_noise_and_find_the_modes_in_the_lines(strategy, force):
    structure = truth()
    result = sysid.identify(problem(structure, force=force), strategy=strategy, rng=0)
    assert result.success
    found, test = result.structure, result.measurement
    left = (test.relative - test.predict(found)) / test.response_std
    assert np.sum(np.abs(left) ** 2) < 1.2 * left.size
    assert found.residual.count
    assert np.all(found.residual.natural_frequencies > FREQ[-1])
    std = result.uncertainty
    for name in ("natural_frequencies", "damping_ratios"):
        far = (getattr(found, name) - getattr(structure, name)) / getattr(std, name)
        assert np.abs(far).max() < 4
    residues = [s.mode_shapes * s.participation[:, 0] for s in (found, structure)]
    assert np.linalg.norm(residues[0] - residues[1]) < 0.03 * np.linalg.norm(residues[1])
    if force:
        far = (found.effective_masses - structure.effective_masses) / std.effective_masses
        assert np.abs(far).max() < 4


def test_without_poles_above_the_lines_nothing_is_added():
    structure = truth().with_residual(sysid.ResidualModes.none(3, 1))
    made = problem(structure)
    assert not made.formulation.matrices.beyond.omega.size
    assert sysid.identify(made, strategy="swarm", rng=0).structure.residual.count == 0

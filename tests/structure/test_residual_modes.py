"""Residual modes against the structure whose modes they are: what is split off answers as before."""

import numpy as np
import pytest

from sysid import InputError, ResidualModes, Structure

FREQ = np.linspace(1.0, 90.0, 200)


def split(truth, kept):
    """The first modes of a structure on as many of its sensors, the others beside them."""
    phi, gamma = truth.mode_shapes, truth.participation
    omega, G = 2 * np.pi * truth.natural_frequencies, truth.rigid_body[:kept]
    P, own = np.linalg.inv(phi[:kept, :kept]), slice(0, kept)
    M, K = P.T @ P, (P.T * omega[own] ** 2) @ P
    M_S0 = P.T @ gamma[own] - M @ G
    delta = gamma[own] - P @ G
    M_00 = delta.T @ delta + truth.rigid_body_mass - gamma[own].T @ gamma[own]
    K_S0 = -K @ G
    loss, free = truth.modal_damping_matrix, truth.modal_damping
    across = np.hstack([loss[kept:, own] @ P, loss[kept:, kept:] - np.diag(np.diag(loss)[kept:])])
    beyond = ResidualModes(
        truth.natural_frequencies[kept:], truth.damping_ratios[kept:], phi[:, kept:], gamma[kept:],
        coupling=None if free else across,
    )  # fmt: skip
    return Structure(
        np.block([[M, M_S0], [M_S0.T, M_00]]), np.block([[K, K_S0], [K_S0.T, -G.T @ K_S0]]),
        truth.damping_ratios[own] if free else None, n_base=truth.n_base,
        damping_matrix=None if free else P.T @ loss[own, own] @ P, recovery=phi[:, own] @ P,
        rigid_body=truth.rigid_body, residual=beyond,
    )  # fmt: skip


@pytest.fixture(params=[(1, False), (3, False), (1, True), (3, True)])
def pair(random_structure, request):
    d, dashpots = request.param
    truth = random_structure(np.random.default_rng(d), n=6, d=d, base_mass=1.0)
    if dashpots:  # which couple modes of the structure with residual ones, and these with each other
        across = np.random.default_rng(7).normal(size=(6, 2))
        more = 0.05 * np.trace(truth.damping) * across @ across.T
        tree = truth.to_tree() | {"damping_ratios": None, "damping_matrix": truth.damping + more}
        truth = Structure.from_tree(tree)
    return truth, split(truth, 4)


def close(found, right, within=1e-9):
    assert found.shape == right.shape and np.abs(found - right).max() <= within * np.abs(right).max()


def test_spectra_are_those_of_all_modes_and_the_structure_is_of_its_own(pair):
    truth, s = pair
    close(s.transmissibility(FREQ), truth.transmissibility(FREQ))
    close(s.base_force(FREQ), truth.base_force(FREQ))
    close(s.rigid_body_mass, truth.rigid_body_mass)
    close(s.natural_frequencies, truth.natural_frequencies[:4])
    assert s.mode_shapes.shape == (6, 4) and s.effective_masses.shape[0] == 4 and not s.at_sensors


def test_answers_in_time_are_those_of_all_modes(pair):
    truth, s = pair
    base = np.random.default_rng(0).normal(size=(truth.n_base, 400))
    close(s.simulate(base, 800.0), truth.simulate(base, 800.0))
    close(s.simulate_force(base, 800.0), truth.simulate_force(base, 800.0))
    state = np.random.default_rng(1).normal(size=(2, 4))  # of its own modes; the others begin at rest
    moving = truth.simulate(base, 800.0, initial=np.hstack([state, np.zeros((2, 2))]))
    signs = np.sign(np.sum(s.mode_shapes * truth.mode_shapes[:, :4], axis=0))
    close(s.simulate(base, 800.0, initial=state * signs), moving)
    close(s.initial_state(base, moving, 800.0), state * signs, 1e-6)


def test_the_state_space_answers_alike(pair):
    truth, s = pair
    system, right = s.to_state_space(), truth.transmissibility(FREQ)
    for w, one in zip(2j * np.pi * FREQ, np.moveaxis(right, -1, 0), strict=True):
        found = system.C @ np.linalg.solve(w * np.eye(len(system.A)) - system.A, system.B) + system.D
        assert np.abs(found - one).max() <= 1e-9 * np.abs(right).max()


@pytest.mark.parametrize("kept", [True, False])
def test_the_craig_bampton_form_holds_them_unless_they_are_left_out(pair, kept):
    truth, s = pair
    form, d = s.to_craig_bampton(residual_vectors=kept), s.n_base
    n = len(form.mass) - d
    assert n == (6 if kept else 4)
    assert not kept or np.linalg.eigvalsh(form.mass)[0] > -1e-9 * np.abs(form.mass).max()
    w = 2 * np.pi * 30.0
    Z = -(w**2) * form.mass + 1j * w * form.damping + form.stiffness
    driven = np.vstack([np.linalg.solve(Z[:n, :n], Z[:n, n:]), -np.eye(d)]) / w**2  # by unit accelerations
    found = -(w**2) * form.recovery @ driven, Z[n:] @ driven
    right = truth.transmissibility([30.0])[..., 0], truth.base_force([30.0])[..., 0]
    alike = [np.abs(a - b).max() <= 1e-9 * np.abs(b).max() for a, b in zip(found, right, strict=True)]
    assert alike == [kept, kept]


def test_they_are_stored_to_the_bit(pair):
    _, s = pair
    again = Structure.from_tree(s.to_tree())
    assert np.array_equal(again.transmissibility(FREQ), s.transmissibility(FREQ)) and again.residual.count == 2


@pytest.mark.parametrize(
    "change",
    [
        {"natural_frequencies": [10.0, -1.0]}, {"damping_ratios": [0.01, -0.1]}, {"damping_ratios": [0.01]},
        {"shapes": np.ones((6, 3))}, {"shapes": np.ones((5, 2))}, {"participation": np.ones((2, 2))}, {"static": 3},
        {"coupling": np.ones((2, 5))},
    ],
)  # fmt: skip
def test_modes_that_do_not_fit_are_refused(pair, change):
    _, s = pair
    given = {"natural_frequencies": [70.0, 80.0], "damping_ratios": [0.01, 0.01], "shapes": np.ones((6, 2)),
             "participation": np.ones((2, s.n_base))} | change  # fmt: skip
    with pytest.raises(InputError, match="residual"):
        Structure(
            s.mass, s.stiffness, s.damping_ratios, n_base=s.n_base, recovery=s.recovery, rigid_body=s.rigid_body,
            residual=ResidualModes(**given),
        )  # fmt: skip

"""Residual modes against the structure whose modes they are: what is split off answers as before."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from sysid import InputError, ResidualModes, Structure
from sysid.modal_analysis.modal_fit import Modes, modes_in_band
from sysid.structure.simulation import ModalModel
from sysid.structure.superelement import in_band, unturned

FREQ = np.linspace(1.0, 90.0, 200)


def split(truth, kept, static=0):
    """The first modes of a structure on as many of its sensors, the others beside them, so many called static."""
    loss, free, own = truth.modal_damping_matrix, truth.modal_damping, slice(0, kept)
    beyond = ResidualModes(
        truth.natural_frequencies[kept:], truth.damping_ratios[kept:], truth.mode_shapes[:, kept:],
        truth.participation[kept:], static,
    )  # fmt: skip
    modes = Modes(truth.mode_shapes, truth.participation, 2 * np.pi * truth.natural_frequencies, truth.damping_ratios)
    loss = loss - np.diag(np.diag(loss))
    modes, beyond, coupled, across = modes_in_band(modes.at(own), beyond, loss[own, own], loss[kept:])
    G, P = truth.rigid_body[:kept], np.linalg.inv(modes.phi[:kept])
    M, K = P.T @ P, (P.T * modes.omega**2) @ P
    M_S0 = P.T @ modes.gamma - M @ G
    delta = modes.gamma - P @ G
    M_00 = delta.T @ delta + truth.rigid_body_mass - modes.gamma.T @ modes.gamma
    K_S0 = -K @ G
    if not free:
        beyond = replace(beyond, coupling=np.hstack([across[:, own] @ P, across[:, kept:]]))
    C = P.T @ (np.diag(2 * modes.ratios * modes.omega) + coupled) @ P
    return Structure(
        np.block([[M, M_S0], [M_S0.T, M_00]]), np.block([[K, K_S0], [K_S0.T, -G.T @ K_S0]]),
        modes.ratios if free else None, n_base=truth.n_base, damping_matrix=None if free else C,
        recovery=modes.phi @ P, rigid_body=truth.rigid_body, residual=beyond,
    )  # fmt: skip


@pytest.fixture(params=[(1, False, 0), (3, False, 0), (1, True, 0), (3, True, 0), (1, True, 2), (3, True, 1)])
def pair(random_structure, request):
    d, dashpots, static = request.param
    truth = random_structure(np.random.default_rng(d), n=6, d=d, base_mass=1.0)
    if dashpots:  # which couple modes of the structure with residual ones, and these with each other
        across = np.random.default_rng(7).normal(size=(6, 2))
        more = 0.05 * np.trace(truth.damping) * across @ across.T
        tree = truth.to_tree() | {"damping_ratios": None, "damping_matrix": truth.damping + more}
        truth = Structure.from_tree(tree)
    return truth, split(truth, 4, static)


def close(found, right, within=1e-9):
    assert found.shape == right.shape and np.abs(found - right).max() <= within * np.abs(right).max()


def test_spectra_are_those_of_all_modes_and_the_structure_is_of_its_own(pair):
    truth, s = pair
    close(s.transmissibility(FREQ), truth.transmissibility(FREQ))
    close(s.base_force(FREQ), truth.base_force(FREQ))
    close(s.rigid_body_mass, truth.rigid_body_mass)
    close(s.natural_frequencies, truth.natural_frequencies[:4], 1e-2 if s.residual.static else 1e-9)
    assert s.mode_shapes.shape == (6, 4) and s.effective_masses.shape[0] == 4 and not s.at_sensors


def test_answers_in_time_are_those_of_all_modes(pair):
    truth, s = pair
    base = np.random.default_rng(0).normal(size=(truth.n_base, 400))
    close(s.simulate(base, 800.0), truth.simulate(base, 800.0))
    close(s.simulate_force(base, 800.0), truth.simulate_force(base, 800.0))
    state = np.random.default_rng(1).normal(size=(2, 4))  # of its own modes; the others begin at rest
    turned = np.linalg.pinv(s.mode_shapes) @ truth.mode_shapes[:, :4]
    moving = truth.simulate(base, 800.0, initial=np.hstack([state, np.zeros((2, 2))]))
    close(s.simulate(base, 800.0, initial=state @ turned.T), moving)
    close(s.initial_state(base, moving, 800.0), state @ turned.T, 1e-6)


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
    own = (2 * np.pi * s.natural_frequencies) ** 2
    assert kept or np.diag(form.stiffness)[:n] == pytest.approx(own, rel=1e-12)
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


def test_modes_with_the_static_answer_are_those_that_the_band_shows():
    """Against the definition: null vectors of the pencil of one's own modes and the static answer, of unit mass."""
    rng = np.random.default_rng(5)
    omega, above = np.array([30.0, 82.0, 125.0]), np.array([344.0, 344.0])
    loss, loss_above = np.diag([1.0, 3.0, 10.0]) + 0.3, np.diag([6.9, 6.9])
    coupling = 30 * rng.normal(size=(2, 3))
    found, T, told = in_band(omega, loss, coupling, above, loss_above)
    whole = lambda w: np.diag(omega**2) - w**2 * np.eye(3) + w**2 * coupling.T / (above**2 - w**2) @ coupling  # noqa: E731
    for k, w in enumerate(found):
        assert np.abs(whole(w) @ T[:, k]).max() < 1e-8 * w**2
        step = 1e-4 * w
        slope = (whole(w + step) - whole(w - step)) / ((w + step) ** 2 - (w - step) ** 2)
        assert -T[:, k] @ slope @ T[:, k] == pytest.approx(1, abs=1e-6)
        # Poles of the whole, by its state matrix: to first order in damping these have the loss told.
    alone = np.diag(2 * 1e-3 * omega) / 100
    _, _, light = in_band(omega, alone, coupling / 1e2, above, loss_above)
    joined = scipy.linalg.block_diag(alone, loss_above)
    joined[3:, :3], joined[:3, 3:] = coupling / 1e2, coupling.T / 1e2
    poles = np.linalg.eigvals(ModalModel(np.append(omega, above), joined, np.zeros((5, 0))).state_matrix)
    poles = np.sort_complex(poles[poles.imag > 0])[::-1]
    nearest = poles[np.abs(poles.imag - omega[:, None]).argmin(axis=1)]
    np.testing.assert_allclose(-2 * nearest.real, np.diag(light), rtol=1e-3)
    again, turn, loss_again = unturned(found, told, coupling @ T, above, loss_above)
    signs = np.sign(np.diag(T @ turn))
    np.testing.assert_allclose(again, omega, rtol=1e-11)
    np.testing.assert_allclose(T @ turn * signs, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(loss_again * np.outer(signs, signs), loss, atol=1e-9)


def test_a_dashpot_that_a_static_mode_overstates_leaves_the_modes_in_the_band():
    """A mode far above at twice the last frequency, of any scale: its couplings move modes, and what is told hardly.

    The unsplit structure has three modes in the band and one far above; the static mode has its flexibility.
    """
    omega, far, above = np.array([30.0, 82.0, 125.0]), 3000.0, 344.0
    loss = np.outer(stretch := np.array([0.3, 0.9, 1.6, 30.0]), stretch) + np.diag([0.6, 1.6, 2.5, 60.0])
    w = np.geomspace(20, 160, 50)
    right = ModalModel(np.append(omega, far), loss, np.array([[5.0], [3.0], [2.0], [0.0]])).motion(w / (2 * np.pi))[:3]
    scale = above / far
    split = np.outer(np.append([1, 1, 1], scale), np.append([1, 1, 1], scale)) * loss
    split[3, 3] = 6.9
    across = split[3:, :3]
    shown, T, told = in_band(omega, split[:3, :3], across, np.array([above]), split[3:, 3:])
    plain = ModalModel(shown, told, T.T @ np.array([[5.0], [3.0], [2.0]])).motion(w / (2 * np.pi))
    answer = np.tensordot(T, plain, 1)
    assert np.abs(answer - right).max() < 2e-3 * np.abs(right).max()
    np.testing.assert_allclose(shown, omega, rtol=2e-4)

"""Poles and shapes beside those of sdypy-EMA (least-squares complex frequency, then least-squares frequency domain)."""

import numpy as np
import pytest

import sysid

SPACING, LINES = 0.25, 1040  # Hz


def shaken(noise):
    """Three masses on unequal springs with one base direction: the truth, and its test."""
    K, G = 1e7 * np.array([[2.5, -1, 0], [-1, 1.8, -0.8], [0, -0.8, 0.8]]), np.ones((3, 1))
    full = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([20.0, 15.0, 10.0, 5.0]), full, [0.01, 0.012, 0.015], n_base=1)
    return truth, sysid.simulate(truth, SPACING * np.arange(1, LINES + 1), noise=noise, force=True, rng=3)


# Without noise what is left is sdypy-EMA's; with it, its poles are biased, those of the third mode most.
@pytest.mark.parametrize(
    ("noise", "frequency", "damping", "shape"), [(0.0, 1e-5, 2e-3, 1e-6), (0.01, 3e-3, 0.06, 1e-3)]
)
def test_poles_shapes_and_residues_are_those_of_sdypy_ema(noise, frequency, damping, shape):
    EMA = pytest.importorskip("sdypy.EMA", reason="needs the extra 'peers'")
    truth, test = shaken(noise)
    # It takes lines from 0 Hz on, where the motion relative to the base is none.
    relative = np.hstack([np.zeros((3, 1)), test.response[0] / test.base[0] - 1.0])
    peer = EMA.Model(relative, SPACING * np.arange(LINES + 1), lower=30, upper=259, pol_order_high=30)
    peer.get_poles(show_progress=False)
    peer.select_closest_poles(truth.natural_frequencies)
    _, residues = peer.get_constants(f_lower=30, f_upper=255)

    found = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), damping=sysid.ModalDamping())).structure
    np.testing.assert_allclose(peer.nat_freq, found.natural_frequencies, rtol=frequency)
    np.testing.assert_allclose(peer.nat_xi, found.damping_ratios, rtol=damping)
    phi, w, zeta = found.mode_shapes, 2 * np.pi * found.natural_frequencies, found.damping_ratios
    sizes = np.sum(np.abs(residues) ** 2, axis=0) * np.sum(phi**2, axis=0)
    assert np.all(1 - np.abs(np.sum(residues.conj() * phi, axis=0)) ** 2 / sizes < shape)
    # v / u_0'' is the sum of -phi gamma / (s² + 2 zeta w s + w²): its residue at the pole, with participations too.
    own = -phi * found.participation[:, 0] / (2j * w * np.sqrt(1 - zeta**2))
    assert np.all(np.abs(residues - own).max(axis=0) < 2 * damping * np.abs(own).max(axis=0))

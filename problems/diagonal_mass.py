"""Diagonal mass with a full stiffness: five masses on a slender column, accelerations only (simulated).

The setting with which the authors of the published method began: five degrees of freedom, each sensor with its own
mass and every one tied to every other by the stiffness (Cerini, Yotov, Aglietti 2024, section 1.3, on their reference
42). Here K is the inverse of the cantilever's flexibility, F_ij = x² (3 X - x) / 6EI with x the lower and X the upper
height. The diagonal form determines the ratios of all masses, and the total, which is known, their size.
"""

import numpy as np

import sysid

MASSES = np.array([30.0, 28.0, 26.0, 24.0, 40.0])  # kg
HEIGHTS = np.linspace(0.8, 4.0, 5)  # m
EI = 2.0e6  # N m²


def column():
    """The true structure."""
    low, high = np.minimum.outer(HEIGHTS, HEIGHTS), np.maximum.outer(HEIGHTS, HEIGHTS)
    K = np.linalg.inv(low**2 * (3 * high - low) / (6 * EI))
    K = (K + K.T) / 2
    G = np.ones((HEIGHTS.size, 1))
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)),
        np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]]),
        [0.012, 0.01, 0.015, 0.02, 0.018],
        n_base=1,
        sensors=[sysid.Sensor(f"mass {i + 1}", (0.0, 0.0, z), "x") for i, z in enumerate(HEIGHTS)],
    )


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("diagonal_mass is simulated and takes no --data")
    truth = column()
    first, *_, last = truth.natural_frequencies
    test = sysid.simulate(truth, np.geomspace(0.5 * first, 1.2 * last, 400), noise=noise, rng=rng)
    return sysid.Problem(
        test,
        mass=sysid.LumpedMass(MASSES.sum()),
        stiffness=sysid.SpectralStiffness(),  # full, its natural frequencies taken from the data
        damping=sysid.ModalDamping(),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )

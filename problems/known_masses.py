"""Known masses, unknown full stiffness: four weighed floors, braces that nobody has listed (simulated).

A mass that can be trusted and a stiffness that cannot is an old assumption (M. Baruch, AIAA J. 16 (1978) 1208-1210):
mass-normalised shapes then have their size, and K = M Phi diag(w²) Phi' M follows. No form is stated for K but that it
is symmetric and positive definite. Masses that are wrong in proportion leave a residual; a wrong common factor does
not: it passes into K and C.
"""

import numpy as np

import sysid

MASSES = np.array([5200.0, 5000.0, 4800.0, 3900.0])  # kg
# N/m between two floors, 0 the base.
BRACES = {(0, 1): 9e6, (1, 2): 8e6, (2, 3): 7e6, (3, 4): 6e6, (0, 2): 3e6, (2, 4): 2e6}


def building():
    """The true structure."""
    K = np.zeros((5, 5))
    for (low, high), k in BRACES.items():
        elongation = np.eye(5)[high - 1] - np.eye(5)[low - 1]  # the base stands last
        K += k * np.outer(elongation, elongation)
    return sysid.Structure(np.diag(np.append(MASSES, 0.0)), K, [0.01, 0.012, 0.02, 0.015], n_base=1)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("known_masses is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.linspace(0.5, 16.0, 300), noise=noise, rng=rng)
    return sysid.Problem(
        test,
        mass=np.diag(MASSES),
        stiffness=sysid.SpectralStiffness(),  # full, its natural frequencies taken from the data
        damping=sysid.ModalDamping(),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )

"""Three-storey shear building with lumped floors, shaken in one direction (simulated).

Masses 10.724, 10.134 and 20.32 kg, 2100 N/m a storey, C = 0.077466 M + 0.00094753 K (Majcher 2025, as given in
the open-access paper). Lumped mass with the total known, a chain of springs, proportional damping: every unknown
is a physical one, and accelerations alone determine them all.
"""

import numpy as np

import sysid

MASSES, SPRINGS = np.array([10.724, 10.134, 20.32]), np.array([2100.0, 2100.0, 2100.0])
ALPHA, BETA = 0.077466, 0.00094753  # 1/s, s


def building():
    """The true structure."""
    K = np.diag(SPRINGS + np.append(SPRINGS[1:], 0)) - np.diag(SPRINGS[1:], 1) - np.diag(SPRINGS[1:], -1)
    K_S0 = -K.sum(axis=1, keepdims=True)
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)),
        np.block([[K, K_S0], [K_S0.T, SPRINGS[:1, None]]]),
        damping_matrix=ALPHA * np.diag(MASSES) + BETA * K,
        n_base=1,
        sensors=[sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 0.3 * (i + 1)), "x") for i in range(3)],
    )


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("shear_building is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.linspace(0.2, 6.0, 300), noise=noise, rng=rng)
    return sysid.Problem(
        test,
        mass=sysid.LumpedMass(MASSES.sum()),
        stiffness=sysid.ChainStiffness(200.0, 20000.0),
        damping=sysid.ProportionalDamping(alpha=(0.0, 1.0), beta=(0.0, 0.01)),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )

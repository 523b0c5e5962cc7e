"""Four-storey frame on force cells with a dashpot between two floors: damping that is not classical (simulated).

A dashpot in one storey couples the modes by what they lose, C = B D B' beside a little damping in proportion to the
stiffness, so that no damping ratios hold it (T. K. Caughey, M. E. J. O'Kelly, J. Appl. Mech. 32 (1965) 583-588).
Nothing is stated of the frame: the base force weighs its modes, and C is found whole, with its intervals, beside M and
K. `--set dashpot=0` is the same frame without it, whose modes are classical.
"""

import numpy as np

import sysid

MASSES = np.array([800.0, 760.0, 700.0, 520.0])  # kg
SPRINGS = np.array([1.6e6, 1.4e6, 1.1e6, 0.8e6])  # N/m
N = MASSES.size
# Elongation of each storey: its upper floor less its lower one; the base stands last.
T = np.eye(N, N + 1) - np.eye(N, N + 1, k=-1) - np.outer(np.eye(N)[0], np.eye(N + 1)[N])
LOSS = 3e-4  # s, of the frame itself: its damping over its stiffness


def frame(dashpot):
    """The true structure, with a dashpot, N s/m, between the second floor and the third."""
    K = T.T @ np.diag(SPRINGS) @ T
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)), K, n_base=1,
        damping_matrix=LOSS * K[:N, :N] + dashpot * np.outer(T[2, :N], T[2, :N]),
        sensors=[sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(N)],
    )  # fmt: skip


def problem(*, data=None, rng=0, noise=0.01, dashpot=1500.0):
    if data is not None:
        raise sysid.InputError("dashpot_frame is simulated and takes no --data")
    truth = frame(dashpot)
    test = sysid.simulate(truth, np.geomspace(1.0, 16.0, 400), noise=noise, force=True, rng=rng, base_axes="x")
    return sysid.Problem(test, reference=truth)

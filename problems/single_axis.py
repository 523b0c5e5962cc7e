"""Two-storey building that sways and twists, shaken along x only, sensors along x and y (simulated).

In each storey frame A stands along y, off the centre; B and C stand along x on either side of it: the building of
unsymmetric plan of Chopra, Dynamics of Structures, chapter 9, with two storeys. The floors are rigid and weighed; the
stiffness of each frame, the radius of gyration of the floors and Rayleigh's damping are unknown. As each frame has its
place, shaking along one axis determines them all, and predicts a test along y that is never fitted. That hangs on B
and C being unequal: with equal ones nothing but x moves, and A and the radius of gyration stay open, as `springs=`
shows. Without the weight of the floors the scale of everything would stay open.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

import sysid

FLOOR, GYRATION, ALPHA, BETA = 20e3, 2.5, 0.2, 1e-3  # kg, m, 1/s, s
SPRINGS = 1e6 * np.array([9.0, 4.0, 7.0, 6.0, 3.0, 5.0])  # N/m: frames A, B, C of storey 1, then of storey 2
FRAMES = np.array([[0.0, 1.0, 0.8], [1.0, 0.0, -3.0], [1.0, 0.0, 3.0]])  # their drift for x, y and turn of a storey
SENSED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -3.0]])  # of a floor: x and y at the centre, x at B
STRETCH = np.kron([[1, 0, -1], [-1, 1, 0]], FRAMES)[:, :8]  # floor 1, floor 2, then base x and y
RECOVERY = np.kron(np.eye(2), SENSED)


def building(springs):
    """The true structure."""
    M, K = np.diag([FLOOR, FLOOR, FLOOR * GYRATION**2] * 2 + [0.0, 0.0]), STRETCH.T @ np.diag(springs) @ STRETCH
    C, G = (ALPHA * M + BETA * K)[:6, :6], np.vstack([SENSED[:, :2]] * 2)
    return sysid.Structure(M, K, damping_matrix=C, n_base=2, recovery=RECOVERY, rigid_body=G)


def problem(*, data=None, rng=0, noise=0.0, springs=SPRINGS):
    if data is not None:
        raise sysid.InputError("single_axis is simulated and takes no --data")
    truth = building(springs)
    both = sysid.simulate(truth, np.linspace(0.5, 9.0, 150), noise=noise, rng=rng)
    stds = [None, None] if noise == 0 else both.response_std[:, None]
    runs = zip(both.base[:, None], both.response[:, None], stds, strict=True)
    along_x, along_y = (replace(both, base=b, response=r, response_std=std) for b, r, std in runs)
    k = sysid.Variable("k", 6, lower=5e5, upper=5e7, log=True, unit="N/m")
    gyration = sysid.Variable("gyration", lower=0.5, upper=6.0, unit="m")
    alpha = sysid.Variable("alpha", lower=0.0, upper=2.0, unit="1/s")
    beta = sysid.Variable("beta", lower=0.0, upper=0.01, unit="s")
    M = ca.diag(ca.vertcat(*[FLOOR, FLOOR, FLOOR * gyration**2] * 2, 0.0, 0.0))
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    return sysid.Problem(
        along_x,
        mass=M,
        stiffness=K,
        damping=alpha * M + beta * K,
        recovery=RECOVERY,
        reference=truth,
        validation=[along_y],
        goal=1e-6 if noise == 0 else 1.05 * along_x.residual(truth),  # or 5 % above the noise floor
    )

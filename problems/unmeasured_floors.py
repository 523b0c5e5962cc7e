"""Five-storey shear building with sensors on the first floor and on the roof only (simulated).

Three floors have no sensor. All but the roof are weighed; the mass of the roof, and springs and dampers of all
storeys are unknown. Udwadia and Sharma (SIAM J. Appl. Math. 34 (1978) 104-118) ask which sensors tell the stiffnesses
of a shear building of known masses: base and first floor leave one answer, base and roof alone several, which fit
alike. So the first floor is measured here; the roof beside it is for the noise. Without any floor weighed the scale of
everything would stay open.
"""

import casadi as ca
import numpy as np

import sysid

FLOORS, ROOF = [1200.0, 1200.0, 1000.0, 1000.0], 800.0  # kg
SPRINGS = np.array([9e5, 8e5, 8e5, 6e5, 5e5])  # N/m, from the base up
DAMPERS = np.array([900.0, 700.0, 900.0, 500.0, 600.0])  # N s/m
STRETCH = (np.eye(6) - np.roll(np.eye(6), 1, axis=0))[:5]  # of a storey: its floor less the one below
SENSED = np.eye(5)[[0, 4]]  # of the floors


def building():
    """The true structure."""
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    M, G = np.diag([*FLOORS, ROOF, 0.0]), np.ones((2, 1))
    return sysid.Structure(M, K, damping_matrix=C[:5, :5], n_base=1, recovery=SENSED, rigid_body=G)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("unmeasured_floors is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.linspace(0.5, 10.0, 200), noise=noise, rng=rng)
    roof = sysid.Variable("roof mass", lower=200.0, upper=3000.0, unit="kg")
    k = sysid.Variable("spring", 5, lower=1e5, upper=4e6, log=True, unit="N/m")
    c = sysid.Variable("damper", 5, lower=50.0, upper=5000.0, log=True, unit="N s/m")
    return sysid.Problem(
        test,
        mass=ca.diag(ca.vertcat(*FLOORS, roof, 0.0)),
        stiffness=STRETCH.T @ ca.diag(k) @ STRETCH,
        damping=STRETCH.T @ ca.diag(c) @ STRETCH,
        recovery=SENSED,
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )

"""Four-storey shear frame on a rigid foundation that sways and rocks on soil springs, three accelerometers.

Degrees of freedom: foundation sway (m), foundation rocking (rad), absolute horizontal motion of floors 1 to 4 (m); then
the table. The foundation (mass, rotary inertia) is known, each floor was weighed to 2 %, storeys get softer upwards.
"""

import casadi as ca
import numpy as np

import sysid

HEIGHT = np.array([1.0, 2.0, 3.0, 4.0])  # m, floors above the foundation
FOUNDATION = (150.0, 60.0)  # kg, kg m^2 (rotary inertia, with that of the floors that turn with it)
#                    sway, rocking, floor 1, 2, 3, 4, table
STRETCH = np.array([
    [1, 0, 0, 0, 0, 0, -1],  # sway spring
    [0, 1, 0, 0, 0, 0, 0],  # rocking spring
    [-1, -1, 1, 0, 0, 0, 0],  # storey 1, height 1 m
    [0, -1, -1, 1, 0, 0, 0],
    [0, -1, 0, -1, 1, 0, 0],
    [0, -1, 0, 0, -1, 1, 0],
], dtype=float)  # fmt: skip
FLOORS = np.hstack([-np.ones((4, 1)), -HEIGHT[:, None], np.eye(4)])  # floors relative to the rigidly moved foundation
RECOVERY = np.eye(6)[[0, 3, 5]]  # accelerometers on the foundation, floors 2 and 4

TRUE = {
    "mass": np.array([105.0, 100.0, 98.0, 85.0]),  # kg
    "storey": np.array([4.6e5, 4.0e5, 3.3e5, 2.6e5]),  # N/m
    "ks": 1.5e6,  # N/m
    "kr": 2.0e6,  # N m/rad
    "cs": 3.4e3,  # N s/m
    "cr": 4.0e3,  # N m s/rad
    "alpha": 0.3,  # 1/s
    "beta": 4e-4,  # s
}


def matrices(mass, storey, ks, kr, cs, cr, alpha, beta):
    """M and K with the table's row last, C without."""
    M = ca.diag(ca.vertcat(*FOUNDATION, mass, 0.0))
    K = STRETCH.T @ ca.diag(ca.vertcat(ks, kr, storey)) @ STRETCH
    C = (STRETCH.T @ ca.diag(ca.vertcat(cs, cr, beta * storey)) @ STRETCH)[:6, :6]
    return M, K, C + alpha * (FLOORS.T @ ca.diag(mass) @ FLOORS)  # Rayleigh damping of the frame alone


def problem(*, data=None, rng=0):
    if data is not None:
        raise ValueError("soil_rocking simulates its test: it takes no --data")
    M, K, C = (np.array(matrix) for matrix in matrices(**TRUE))
    places = (("foundation", 0.0), ("floor 2", 2.0), ("floor 4", 4.0))
    sensors = [sysid.Sensor(name, (0, 0, z), "x") for name, z in places]
    truth = sysid.Structure(M, K, damping_matrix=C, n_base=1, recovery=RECOVERY, sensors=sensors)
    test = sysid.simulate(truth, np.linspace(0.5, 45.0, 900), noise=0.01, rng=rng)
    weighed = TRUE["mass"] * (1 + 0.02 * np.random.default_rng([rng, 1]).standard_normal(4))

    m = sysid.Variable("floor mass", 4, lower=50.0, upper=200.0, unit="kg")
    k = sysid.Variable("storey stiffness", 4, lower=5e4, upper=5e6, log=True, unit="N/m")
    ks = sysid.Variable("sway spring", lower=1e5, upper=2e7, log=True, unit="N/m")
    kr = sysid.Variable("rocking spring", lower=1e5, upper=2e7, log=True, unit="N m/rad")
    cs = sysid.Variable("sway damper", lower=1e2, upper=1e5, log=True, unit="N s/m")
    cr = sysid.Variable("rocking damper", lower=1e2, upper=1e5, log=True, unit="N m s/rad")
    alpha = sysid.Variable("alpha", lower=0.0, upper=2.0, unit="1/s")
    beta = sysid.Variable("beta", lower=0.0, upper=5e-3, unit="s")
    M, K, C = matrices(m, k, ks, kr, cs, cr, alpha, beta)
    return sysid.Problem(
        test, mass=M, stiffness=K, damping=C, recovery=RECOVERY, reference=truth,
        constraints=[k[i] >= k[i + 1] for i in range(3)],
        residuals=[sysid.Prior(m[i], weighed[i], std=0.02 * weighed[i]) for i in range(4)],
    )  # fmt: skip

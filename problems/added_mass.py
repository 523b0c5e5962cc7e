"""Two tests of one structure, the second with a known mass added, which weighs everything (simulated).

Accelerations of a lumped mass leave its scale open, and with it that of stiffness and damping. A known mass, fixed to
the structure for a second test, moves the frequencies by an amount that gives the scale: the mass-change method of
modal scaling (Parloo, Verboven, Guillaume, Van Overmeire, Mech. Syst. Signal Process. 16 (2002) 757-767), here in one
fit of both tests. Masses, springs and dampers of a frame of three floors are unknown; 8 kg, a twentieth of it, go
on its roof. `problem(added=0.0)` shows what is open without them.
"""

import casadi as ca
import numpy as np

import sysid

MASSES = np.array([60.0, 55.0, 45.0])  # kg
SPRINGS = np.array([9e4, 8e4, 6e4])  # N/m, from the base up
DAMPERS = np.array([90.0, 60.0, 70.0])  # N s/m
STRETCH = np.array([[1, 0, 0, -1], [-1, 1, 0, 0], [0, -1, 1, 0]])  # of a storey: its floor less the one below
ROOF = np.diag([0.0, 0.0, 1.0])


def frame(masses):
    """The true structure."""
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    sensors = [sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 0.5 * (i + 1)), "x") for i in range(3)]
    return sysid.Structure(np.diag([*masses, 0.0]), K, damping_matrix=C[:3, :3], n_base=1, sensors=sensors)


def problem(*, data=None, rng=0, noise=0.0, added=8.0):
    if data is not None:
        raise sysid.InputError("added_mass is simulated and takes no --data")
    truth, heavier = frame(MASSES), frame(MASSES + added * np.diag(ROOF))
    freq, random = np.linspace(1.0, 12.0, 250), np.random.default_rng(rng)
    bare, loaded = (sysid.simulate(structure, freq, noise=noise, rng=random) for structure in (truth, heavier))
    m = sysid.Variable("mass", 3, lower=10.0, upper=300.0, log=True, unit="kg")
    k = sysid.Variable("spring", 3, lower=1e4, upper=1e6, log=True, unit="N/m")
    c = sysid.Variable("damper", 3, lower=5.0, upper=1000.0, log=True, unit="N s/m")
    M, K, C = ca.diag(m), STRETCH.T @ ca.diag(k) @ STRETCH, STRETCH.T @ ca.diag(c) @ STRETCH
    return sysid.Problem(
        bare,
        mass=M,
        stiffness=K,
        damping=C,
        residuals=[sysid.FurtherTest(loaded, mass=M + added * ROOF, stiffness=K, damping=C)],
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * bare.residual(truth),  # or 5 % above the noise floor
    )

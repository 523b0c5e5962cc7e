"""A result that every format is tried on."""

import numpy as np
import pytest

import sysid


@pytest.fixture(scope="session")
def result() -> sysid.Identification:
    """Three masses on a base that moves in x and turns about y, with force, so that all matrices are determined."""
    K = 1e5 * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    sensors = [sysid.Sensor(f"floor {k}", (0.0, 0.0, float(k)), "x") for k in (1, 2, 3)]
    G = np.array([[1.0, z] for z in (1.0, 2.0, 3.0)])
    full = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([20.0, 15.0, 10.0, 5.0, 8.0]), full, [0.01, 0.012, 0.015], n_base=2)
    freq = np.linspace(2.0, 40.0, 150)
    test = sysid.Measurement.from_frf(
        freq,
        truth.transmissibility(freq),
        force=truth.base_force(freq),
        rigid_body=G,
        base_axes="x ry",
        sensors=sensors,
    )
    damping = sysid.ModalDamping()
    return sysid.identify(
        sysid.Problem(test, mass=sysid.FullMass(), stiffness=sysid.SpectralStiffness(), damping=damping)
    )


@pytest.fixture(scope="session")
def noisy():
    """Three masses that shake with 1 % noise: the truth, and what is found with and without the force of the base."""
    K, G = 1e5 * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]]), np.ones((3, 1))
    full = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    truth = sysid.Structure(np.diag([20.0, 15.0, 10.0, 5.0]), full, [0.01, 0.012, 0.015], n_base=1)
    found = []
    for force in (True, False):
        test = sysid.simulate(truth, np.linspace(2.0, 40.0, 150), noise=0.01, force=force, rng=3)
        mass = sysid.FullMass() if force else sysid.FullMass(50.0)
        found.append(sysid.identify(sysid.Problem(test, mass=mass, damping=sysid.ModalDamping())))
    return truth, *found


@pytest.fixture(scope="session")
def in_band(random_structure) -> sysid.Identification:
    """Four modes in the lines on six sensors; the two above are residual modes."""
    frequencies = [8.0, 13.0, 19.0, 26.0, 44.0, 52.0]
    truth = random_structure(np.random.default_rng(8), 6, 2, frequencies=np.array(frequencies), base_mass=1.0)
    test = sysid.simulate(truth, np.linspace(4.0, 32.0, 300), force=True, noise=0.002, rng=0)
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)

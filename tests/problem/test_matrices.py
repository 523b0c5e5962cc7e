"""Matrices of x: every mass with every stiffness and every damping, written, model or numbers, against NumPy."""

from itertools import product

import casadi as ca
import numpy as np
import pytest

import sysid

N, D = 3, 2
GROUPS = np.array([0, 1, 0])  # the base direction of each sensor
G = np.eye(D)[GROUPS]
TOTALS = np.array([5.0, 7.0])
KNOWN = np.array([[3.0, 0.2, 0, 0.1, 0], [0.2, 2, 0, 0, 0.3], [0, 0, 1, 0, 0], [0.1, 0, 0, 2, 0], [0, 0.3, 0, 0, 1]])
STIFF = np.array([[500.0, -20, -80], [-20, 300, 10], [-80, 10, 200]])
TEST = sysid.Measurement(
    [1.0, 2.0, 3.0], np.ones((1, D, 3)), np.arange(9.0).reshape(1, 3, 3), rigid_body=G, base_axes="xy"
)  # fmt: skip


def triangle(entries, size):
    L = np.zeros((size, size))
    L[np.tril_indices(size)] = entries
    return L


def full(x):
    """Each row of the factor times the scale of its direction, so that the trace of the direction is its total."""
    raw, direction = triangle(x, N + D), np.array([*GROUPS, *range(D)])
    scale = [np.sqrt(TOTALS[i] / np.sum(raw[direction == i] ** 2)) for i in range(D)]
    factor = np.array(scale)[direction][:, None] * raw
    return factor @ factor.T


def lumped(x):
    return np.diag([*(TOTALS[g] * s / x[g == GROUPS].sum() for g, s in zip(GROUPS, x, strict=True)), 0, 0])


def whole_mass(m):
    """Floors, a coupling of the first to the base, and the base's own."""
    return ca.blockcat([[ca.diag(m), 0.1 * ca.vertcat(m[0], 0, 0), ca.MX(3, 1)],
                        [0.1 * ca.horzcat(m[0], 0, 0), 2.0, 0], [ca.MX(1, 3), 0, 1.5]])  # fmt: skip


def whole_numbers(m):
    M = np.diag([*m, 2.0, 1.5])
    M[0, 3] = M[3, 0] = 0.1 * m[0]
    return M


def spectral(x, M):
    """K = L H L' with H = L_H L_H'."""
    root = np.linalg.cholesky(M[:N, :N]) @ triangle(x, N)
    return root @ root.T


def springs(k):
    """Sensors 1 and 3 above each other along x, sensor 2 alone along y."""
    return np.array([[k[0] + k[2], 0, -k[2]], [0, k[1], 0], [-k[2], 0, k[2]]])


def variable(name):
    return sysid.Variable(name, 3, lower=0.5, upper=2.0)


# For each kind: what a problem is given (of a variable), whether it is a model, and the same in NumPy.
MASS = {
    "full": (lambda v: sysid.FullMass(TOTALS), full),
    "lumped": (lambda v: sysid.LumpedMass(TOTALS), lumped),
    "known": (lambda v: KNOWN, lambda x: KNOWN),
    "over the sensors": (lambda v: sysid.KnownMass(KNOWN[:N, :N]), lambda x: np.pad(KNOWN[:N, :N], (0, D))),
    "written": (lambda v: whole_mass(v), whole_numbers),
}
STIFFNESS = {
    "spectral": (lambda v: sysid.SpectralStiffness([4.0, 6.0, 9.0]), spectral),
    "chain": (lambda v: sysid.ChainStiffness(10.0, 1e4), lambda x, M: springs(x)),
    "numbers": (lambda v: STIFF, lambda x, M: STIFF),
    "written": (lambda v: STIFF + 100 * ca.diag(v), lambda x, M: STIFF + 100 * np.diag(x)),
}
DAMPING = {
    "modal": (lambda v: sysid.ModalDamping(0.001, 0.3), lambda x, M, K: None, lambda x, w: x),
    "proportional": (
        lambda v: sysid.ProportionalDamping((0, 1), (0, 1e-2)),
        lambda x, M, K: x[0] * M[:N, :N] + x[1] * K,
        lambda x, w: x[0] / (2 * w) + x[1] * w / 2,
    ),
    "matrix": (lambda v: ca.diag(v) + 0.1, lambda x, M, K: np.diag(x) + 0.1, lambda x, w: None),
    "ratios": (lambda v: 0.01 * v, lambda x, M, K: None, lambda x, w: 0.01 * x),
    "known ratios": (lambda v: [0.01, 0.02, 0.03], lambda x, M, K: None, lambda x, w: np.array([0.01, 0.02, 0.03])),
}  # fmt: skip
SIZES = {"full": 15, "lumped": 3, "spectral": 6, "chain": 3, "modal": 3, "proportional": 2}


def drawn(rng, name):
    """Unknowns of a model, or of the variable that is written with."""
    if name == "full":
        return (rng.uniform(-0.3, 0.3, (N + D, N + D)) + 0.5 * np.eye(N + D))[np.tril_indices(N + D)]
    if name == "spectral":
        return (rng.uniform(-5, 5, (N, N)) + np.diag([20.0, 30, 40]))[np.tril_indices(N)]
    bounds = {"lumped": (0.2, 1), "chain": (50, 500), "modal": (0.005, 0.05), "proportional": (1e-3, 9e-3)}
    return rng.uniform(*bounds.get(name, (0.6, 1.8)), SIZES.get(name, 3))


@pytest.mark.parametrize(("mass", "stiffness", "damping"), list(product(MASS, STIFFNESS, DAMPING)))
def test_matrices_and_ratios_are_those_of_numpy(mass, stiffness, damping):
    rng = np.random.default_rng([len(mass), len(stiffness), len(damping)])
    names, kinds = (mass, stiffness, damping), (MASS, STIFFNESS, DAMPING)
    variables = [variable(name) for name in "mkc"]
    given = [kind[name][0](v) for kind, name, v in zip(kinds, names, variables, strict=True)]
    if not any(name in (*SIZES, "written", "matrix", "ratios") for name in names):
        with pytest.raises(sysid.InputError, match="no unknowns"):
            sysid.Problem(TEST, mass=given[0], stiffness=given[1], damping=given[2])
        return
    problem = sysid.Problem(TEST, mass=given[0], stiffness=given[1], damping=given[2])

    parts = [drawn(rng, name) for name in names]
    models = [part for part, name in zip(parts, names, strict=True) if name in SIZES]
    written = [part for part, name in zip(parts, names, strict=True) if name in ("written", "matrix", "ratios")]
    x = np.concatenate([np.zeros(0), *models, *written])
    M = MASS[mass][1](parts[0])
    K = STIFFNESS[stiffness][1](parts[1], M)
    C, L = DAMPING[damping][1](parts[2], M, K), np.linalg.cholesky(M[:N, :N])
    H = np.linalg.solve(L, np.linalg.solve(L, K).T)
    expected = (M[:N, :N], M[:N, N:], M[N:, N:], K, C, L, H)

    matrices = problem.formulation.matrices
    for made, wanted in zip(matrices.function(x), expected, strict=True):
        if wanted is None:
            assert made.numel() == 0
        else:
            size = np.abs(wanted).max()
            np.testing.assert_allclose(np.asarray(ca.densify(made)), wanted, rtol=1e-11, atol=1e-13 * size)
    omega = np.sqrt(np.linalg.eigvalsh(H))
    ratios = DAMPING[damping][2](parts[2], omega)
    made = np.asarray(ca.densify(matrices.ratio_function(x, omega))).ravel()
    np.testing.assert_allclose(made, np.zeros(0) if ratios is None else ratios, rtol=1e-9)
    assert matrices.by_ratios is (ratios is not None)
    assert problem.formulation.by_ratios is (ratios is not None)

    structure = problem.structure(x)
    base = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    wanted = sysid.Structure(M, base, ratios, damping_matrix=C if ratios is None else None, n_base=D)
    for name in ("mass", "stiffness", "damping", "damping_ratios"):
        made, there = getattr(structure, name), getattr(wanted, name)
        np.testing.assert_allclose(made, there, rtol=1e-9, atol=1e-11 * np.abs(there).max(), err_msg=name)


@pytest.mark.parametrize("semidefinite", [True, False])
def test_only_a_mass_of_its_factor_is_semidefinite_for_every_unknown(semidefinite):
    """Written out it is checked for each candidate: with m = 0.5 its base is lighter than its coupling asks for."""
    m = sysid.Variable("m", 3, lower=0.5, upper=2.0)
    mass = sysid.LumpedMass(TOTALS) if semidefinite else ca.blockcat([[ca.diag(m), 0.8 * G], [0.8 * G.T, ca.DM.eye(2)]])
    problem = sysid.Problem(TEST, mass=mass, stiffness=STIFF)
    assert problem.formulation.matrices.semidefinite is semidefinite
    x = problem.formulation.guess
    if not semidefinite:
        # M_00 - M_S0' M_SS^-1 M_S0 along x is 1 - 0.64 (1/m1 + 1/m3).
        for value, there in ((2.0, True), (1.25, False)):
            x[-3:] = value
            assert np.isfinite(problem.formulation.own_test.squared(x[None])[0]) == there
            assert np.isfinite(problem.objective(x)) == there


def test_degrees_of_freedom_that_are_no_sensors():
    """Two sensors on three degrees of freedom: matrices of the latter, records of the former."""
    R = np.array([[1.0, 0, 0], [0, 0.5, 0.5]])
    dofs = np.array([[1.0], [1.0], [1.0]])
    test = sysid.Measurement([1.0, 2.0], np.ones((1, 1, 2)), np.ones((1, 2, 2)) * 3, rigid_body=R @ dofs)
    problem = sysid.Problem(
        test, mass=sysid.LumpedMass(6.0), stiffness=STIFF + ca.diag(variable("k")), damping=[0.01, 0.01, 0.01],
        recovery=R, rigid_body_dofs=dofs,
    )  # fmt: skip
    x = np.array([0.2, 0.5, 0.5, 1, 1, 1])
    structure = problem.structure(x)
    np.testing.assert_allclose(np.diag(structure.mass), [1, 2.5, 2.5, 0])
    np.testing.assert_allclose(structure.stiffness[:3, :3], STIFF + np.eye(3))
    np.testing.assert_array_equal(structure.recovery, R)
    np.testing.assert_allclose(structure.rigid_body, R @ dofs)
    assert problem.geometry.n == 3
    assert not problem.geometry.at_sensors

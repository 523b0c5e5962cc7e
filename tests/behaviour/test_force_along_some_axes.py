"""A force along x alone of a base that moves along x and turns about y: what it determines, and how it is fitted."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

import sysid
from sysid.files.assembly import run_of
from sysid.files.description import Channel, Description

HEIGHTS = np.array([1.0, 2.0, 3.1])
MASS, SPRINGS = np.array([4.0, 3.0, 2.0]), np.array([9000.0, 7000.0, 5000.0])
BASE = np.array([[1.5, 0.3], [0.3, 0.8]])  # kg, kg m, kg m²
ALPHA, BETA = 0.6, 4e-4
G = np.column_stack([np.ones(3), HEIGHTS])
STRETCH = np.array([[1.0, 0, 0], [-1, 1, 0], [0, -1, 1]])
K = STRETCH.T @ np.diag(SPRINGS) @ STRETCH
OMEGA, SHAPES = (lambda w2, phi: (np.sqrt(w2), phi))(*scipy.linalg.eigh(K, np.diag(MASS)))
FREQ = np.linspace(0.4 * OMEGA[0], 1.3 * OMEGA[-1], 250) / (2 * np.pi)
NOISE = 0.003


def functions(theta):
    """Relative accelerations (3, 2, lines) and base force (2, 2, lines) by sums over the modes.

    Of shapes, participations, log w, log zeta and the upper triangle of M_rb.
    """
    phi, gamma = theta[:9].reshape(3, 3), theta[9:15].reshape(3, 2)
    w, (wk, ratio) = 2 * np.pi * FREQ, np.exp(theta[15:21]).reshape(2, 3, 1)
    g = w**2 / (wk**2 - w**2 + 2j * ratio * wk * w)
    rigid = theta[21:][[[0, 1], [1, 2]]]
    return np.einsum("sk,kf,kd->sdf", phi, g, gamma), np.einsum("ke,kf,kd->edf", gamma, g, gamma) + rigid[..., None]


def truth():
    gamma, rigid = SHAPES.T @ (MASS[:, None] * G), G.T @ (MASS[:, None] * G) + BASE
    ratios = ALPHA / (2 * OMEGA) + BETA * OMEGA / 2
    return np.concatenate([SHAPES.ravel(), gamma.ravel(), np.log(OMEGA), np.log(ratios), rigid[[0, 0, 1], [0, 1, 1]]])


@pytest.mark.parametrize(("rows", "open_"), [([0], 1), ([0, 1], 0), ([], 6)])
def test_a_force_along_x_leaves_the_inertia_about_y_open_and_nothing_else(rows, open_):
    """By the rank of central differences of fourth order."""

    def every(theta):
        a, force = functions(theta)
        parts = np.concatenate([a.ravel(), force[rows].ravel()])
        return np.concatenate([parts.real, parts.imag])

    at = truth()
    steps = 1e-5 * np.eye(at.size)
    columns = [
        (every(at - 2 * s) - 8 * every(at - s) + 8 * every(at + s) - every(at + 2 * s)) / (12 * s.max()) for s in steps
    ]
    _, sizes, right = np.linalg.svd(np.array(columns).T / np.maximum(np.linalg.norm(columns, axis=1), 1.0))
    assert np.count_nonzero(sizes < 1e-7 * sizes[0]) == open_
    if open_ == 1:
        np.testing.assert_allclose(np.abs(right[-1]), np.eye(at.size)[-1], atol=1e-6)


def test_the_row_of_a_force_beside_a_written_model_fixes_it(from_one_start):
    rng, (a, force) = np.random.default_rng(0), functions(truth())
    parts = [np.moveaxis(a + G[..., None], 1, 0), force[:1]]  # runs of unit motion first
    noisy = []
    for part in parts:
        e = rng.standard_normal((2, *part.shape)) / np.sqrt(2)
        noisy.append(part + NOISE * np.sqrt(np.mean(np.abs(part) ** 2)) * (e[0] + 1j * e[1]))
    sensors = [sysid.Sensor(f"floor {i}", (0.0, 0.0, float(z)), "x") for i, z in enumerate(HEIGHTS, start=1)]
    test = sysid.Measurement(FREQ, np.eye(2)[..., None] * np.ones(FREQ.size), noisy[0], sensors=sensors,
                             base_axes="x ry")  # fmt: skip
    f_x = noisy[1].reshape(1, -1)
    m, k = (sysid.Variable(name, 3, lower=low, upper=high) for name, low, high in (("m", 1.0, 10.0), ("k", 1e3, 3e4)))
    base = sysid.Variable("base", 2, lower=[0.0, -2.0], upper=[5.0, 2.0])
    a, b = sysid.Variable("a", lower=0.0, upper=5.0), sysid.Variable("b", lower=1e-6, upper=1e-2)
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    M_00 = ca.vertcat(ca.horzcat(base[0], base[1]), ca.horzcat(base[1], 1.0))
    model = {
        "mass": ca.diagcat(ca.diag(m), M_00), "damping": a * ca.diag(m) + b * K,
        "stiffness": ca.vertcat(ca.horzcat(K, -K @ G), ca.horzcat(-(K @ G).T, G.T @ K @ G)),
    }  # fmt: skip
    left = np.array([[1.0, 0.0]]) @ sysid.FurtherTest(test, **model).force - f_x
    given = [part / np.linalg.norm(f_x) for part in (left.real, left.imag)]
    with from_one_start():
        result = sysid.identify(sysid.Problem(test, **model, residuals=given), rng=0)
    assert result.judgement == "determined"
    np.testing.assert_allclose(result.values["m"], MASS, rtol=2e-3)
    np.testing.assert_allclose(result.values["k"], SPRINGS, rtol=2e-3)
    np.testing.assert_allclose(result.values["base"], BASE[0], atol=0.05)


def test_a_force_in_fewer_directions_than_the_base_is_refused_with_what_to_do():
    waves = np.random.default_rng(0).standard_normal((6, 50))
    run, G1 = (waves[:2], waves[2:5], waves[5:]), G
    spectra = np.ones((2, 2, 9))
    for refused in (
        lambda: sysid.Measurement.from_time([run], 50.0, rigid_body=G1, base_axes="x ry"),
        lambda: sysid.Measurement(np.arange(1, 10.0), spectra, np.ones((2, 3, 9)), rigid_body=G1, base_axes="x ry",
                                  force=spectra[:, :1]),
        lambda: sysid.Measurement.from_frf(np.arange(1, 10.0), np.ones((3, 2, 9)), rigid_body=G1, base_axes="x ry",
                                           force=spectra[:1]),
    ):  # fmt: skip
        with pytest.raises(sysid.InputError, match="own_unknowns"):
            refused()


def test_one_load_cell_off_the_base_point_tells_no_moment():
    """Its arm about the point is no moment of all that the base carries: cells of full rank are needed."""
    said = Description(channels=(), base_axes="x ry")
    described = [("base", "x", 0.0), ("base", "ry", 0.0), ("response", "x", 2.0), ("force", "x", -0.1)]
    parts = [
        (Channel(i, role, axis, f"{role} {axis}", (0.0, 0.0, z), "", "", 1.0), np.ones(5))
        for i, (role, axis, z) in enumerate(described)
    ]
    said = replace(said, channels=tuple(channel for channel, _ in parts))
    with pytest.raises(sysid.InputError, match="1 of x ry"):
        run_of(parts, said, ("x", "ry"), "test.csv")

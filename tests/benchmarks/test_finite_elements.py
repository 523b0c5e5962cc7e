"""Finite elements of the benchmark of continuous structures, against closed forms."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def fe():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        return importlib.import_module("benchmarks.band.finite_elements")


@pytest.fixture(scope="module")
def material(fe):
    return fe.Material(70e9, 0.33, 2700.0)


def _cantilever(fe, section, length, elements, direction=(1, 0, 0)):
    """A clamped beam along a direction from the origin, on a base with all six axes."""
    model = fe.Model(np.outer(np.linspace(0, length, elements + 1), direction))
    for i in range(elements):
        model.beam(i, i + 1, section, up=(0.2, 0.3, 1.0))
    return model


def _cantilever_numbers(count):
    """Roots of cos(x) cosh(x) = -1."""
    return np.array([
        scipy.optimize.brentq(lambda x: np.cos(x) + 1 / np.cosh(x), k * np.pi, (k + 1) * np.pi) for k in range(count)
    ])  # fmt: skip


def test_a_cantilever_has_its_bending_axial_and_torsional_frequencies(fe, material):
    """In any direction of space: bending in both planes errs by (beta h)⁴/1440, tension and torsion by (kappa h)²/24.

    Leading terms of the elements' dispersion (Strang and Fix, An Analysis of the Finite Element Method, section 6.3).
    """
    section, length = fe.Section.rectangle(material, 0.03, 0.02), 1.3
    speed = np.sqrt(material.young / material.density)
    shear = material.young / (2 * (1 + material.poisson))
    twist = np.sqrt(shear * section.torsion / (material.density * (section.about_y + section.about_z)))
    bending, stretching = _cantilever_numbers(3) / length, np.pi / 2 * np.array([1, 3]) / length
    radii = np.sqrt([section.about_y / section.area, section.about_z / section.area])
    direction = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    step = length / 20
    omega, _ = _cantilever(fe, section, length, 20, direction).on_base(fe.AXES, clamped=[0]).modes()
    for exact, error in (
        *((bending**2 * speed * radius, (bending * step) ** 4 / 1440) for radius in radii),
        *((stretching * it, (stretching * step) ** 2 / 24) for it in (speed, twist)),
    ):
        nearest = omega[np.argmin(np.abs(omega[:, None] / exact - 1), axis=0)]
        np.testing.assert_allclose(nearest / exact - 1, error, rtol=0.02)


def test_rigid_body_mass_of_beams_plates_and_bodies_is_exact(fe, material):
    """Mass, first moments and moments of inertia about the base point, in closed form."""
    section, length = fe.Section.rectangle(material, 0.03, 0.02), 1.3
    model = _cantilever(fe, section, length, 3)
    offset, inertia, body = np.array([0.1, -0.2, 0.05]), np.array([0.01, 0.02, 0.03]), 0.7
    model.rigid_mass(3, body, inertia, offset)
    found = model.on_base(fe.AXES, clamped=[0]).rigid_body_mass
    line = material.density * section.area * length
    total, centre = line + body, np.array([length, 0, 0]) + offset
    first = np.array([line * length / 2, 0, 0]) + body * centre
    x, y, z = first
    along = np.array([
        material.density * (section.about_y + section.about_z) * length, line * length**2 / 3, line * length**2 / 3
    ])  # fmt: skip
    turning = np.diag(along + inertia) + body * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    across = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    np.testing.assert_allclose(found, np.block([[total * np.eye(3), across], [across.T, turning]]), atol=1e-12)

    a, b, t = 0.9, 0.6, 0.005
    plate, _ = _plate(fe, material, a, b, t, 2, 3)
    found = plate.on_base(["z", "rx", "ry"], moving=["z", "rx", "ry"]).rigid_body_mass
    mass = material.density * a * b * t
    exact = mass * np.array([[1, b / 2, -a / 2], [b / 2, b**2 / 3, -a * b / 4], [-a / 2, -a * b / 4, a**2 / 3]])
    np.testing.assert_allclose(found, exact, rtol=1e-12)


def _plate(fe, material, a, b, thickness, nx, ny):
    """A plate with a corner at the origin, and the numbers of its nodes, (nx + 1, ny + 1)."""
    x, y = np.meshgrid(np.linspace(0, a, nx + 1), np.linspace(0, b, ny + 1), indexing="ij")
    model = fe.Model(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    number = np.arange(x.size).reshape(x.shape)
    for i in range(nx):
        for j in range(ny):
            model.plate([number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], thickness, material)
    return model, number


def _held(model, held):
    """Eigenvalues of a model without base, some degrees of freedom held, of its plate's three axes."""
    kept = np.array([6 * i + axis for i in range(len(model.nodes)) for axis in (2, 3, 4) if (i, axis) not in held])
    at = np.ix_(kept, kept)
    return scipy.linalg.eigh(model.stiffness[at], model.mass[at], eigvals_only=True)


def test_a_simply_supported_plate_converges_to_navier(fe, material):
    """w² = D/(rho h) pi⁴ ((i/a)² + (j/b)²)², with h²."""
    a, b, t = 0.9, 0.6, 0.005
    rigidity = material.young * t**3 / (12 * (1 - material.poisson**2))
    modes = [(1, 1), (2, 1)]
    exact = np.sort([
        np.sqrt(rigidity / (material.density * t)) * np.pi**2 * ((i / a) ** 2 + (j / b) ** 2) for i, j in modes
    ])  # fmt: skip
    errors = []
    for n in (8, 16):
        model, number = _plate(fe, material, a, b, t, n, n)
        held = {(k, 2) for k in (*number[0], *number[-1], *number[:, 0], *number[:, -1])}
        held |= {(k, 3) for k in (*number[0], *number[-1])} | {(k, 4) for k in (*number[:, 0], *number[:, -1])}
        errors.append(np.sqrt(_held(model, held)[:2]) / exact - 1)
    assert np.all(np.abs(errors[1]) < 0.005)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)


def test_a_free_square_plate_has_its_rigid_motions_and_known_frequencies(fe, material):
    """Three of zero, then lambda = 13.468, 19.596, 24.270 at Poisson's ratio 0.3.

    Liew, Xiang and Kitipornchai, Computers & Structures 49 (1993) 1-29; Leissa's of 1973 are up to 1 % above.
    """
    a, t = 0.7, 0.004
    metal = material._replace(poisson=0.3)
    rigidity = metal.young * t**3 / (12 * (1 - metal.poisson**2))
    model, _ = _plate(fe, metal, a, a, t, 12, 12)
    squares = _held(model, set())
    assert np.all(np.abs(squares[:3]) < 1e-6 * squares[3])
    found = np.sqrt(squares[3:6] * metal.density * t / rigidity) * a**2
    assert found == pytest.approx([13.468, 19.596, 24.270], rel=1e-3)


def test_springs_carry_a_rigid_body_as_an_oscillator(fe):
    """A body on springs at its node: sqrt(k/m) along each axis, sqrt(k/J) about it."""
    model = fe.Model([[0.3, -0.2, 0.1]])
    model.rigid_mass(0, 2.0, (0.1, 0.2, 0.3))
    model.spring(0, (1e3, 2e3, 3e3, 40.0, 50.0, 60.0))
    omega, _ = model.on_base(["x"]).modes()
    assert omega == pytest.approx(np.sort(np.sqrt([500, 1000, 1500, 400, 250, 200])))


def test_effective_masses_of_all_modes_and_what_is_clamped_are_the_rigid_body_mass(fe, material):
    """For rotations of the base too; and their static sum is the compliance under inertia loads."""
    section = fe.Section.rectangle(material, 0.03, 0.02)
    model = _cantilever(fe, section, 1.3, 6)
    model.rigid_mass(6, 0.7, (0.01, 0.02, 0.03), (0.1, -0.2, 0.05))
    driven = model.on_base(fe.AXES, clamped=[0])
    omega, shapes = driven.modes()
    gamma = shapes.T @ driven.load
    rest = driven.rigid_body_mass - driven.load.T @ np.linalg.solve(driven.mass, driven.load)
    np.testing.assert_allclose(gamma.T @ gamma + rest, driven.rigid_body_mass, atol=1e-9)
    static = driven.load.T @ np.linalg.solve(driven.stiffness, driven.load)
    np.testing.assert_allclose(gamma.T @ (gamma / omega[:, None] ** 2), static, rtol=1e-9, atol=1e-12)

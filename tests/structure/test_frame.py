"""Frames against closed forms, mechanics that any frame obeys, and CasADi against differences."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from sysid.errors import InputError
from sysid.frame import Beam, Frame, PointMass, Section
from sysid.structure.sensor import Sensor, rigid_body

BETA_L = np.array([1.875104068711961, 4.694091132974175, 7.854757438237613])  # cos x cosh x = -1
E, G, A, IY, IZ, J, RHO = 70e9, 26e9, 3e-4, 2e-9, 7e-9, 5e-9, 2700.0
LENGTH = 0.8


def section(**changes):
    return Section(**({"E": E, "G": G, "A": A, "Iy": IY, "Iz": IZ, "J": J, "density": RHO} | changes))


def cantilever(n_beams, *, mass="consistent", turn=None, point_masses=(), **changes):
    """Along x from the origin, bending in y with Iz and in z with Iy, then turned as a whole."""
    turn = np.eye(3) if turn is None else turn
    nodes = np.linspace([0, 0, 0], [LENGTH, 0, 0], n_beams + 1) @ turn.T
    s = section(**changes)
    return Frame(nodes, [Beam(i, i + 1, s, turn[:, 1]) for i in range(n_beams)], point_masses, mass)


def rotation():
    q, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def portal(mass="consistent", **changes):
    """Two columns and a skew beam out of plane, no symmetry, two base nodes and a point mass."""
    nodes = np.array(
        [[0, 0, 0], [1, 0.2, 0], [0, 0, 0.9], [1, 0.2, 1.1], [0.5, 0.3, 1.0], [0.5, 0.9, 1.2]], dtype=float
    )
    s, t = section(**changes), section(A=2 * A)
    beams = [Beam(0, 2, s, (1, 0, 0)), Beam(1, 3, s, (1, 1, 0)), Beam(2, 4, t, (0, 0, 1)), Beam(3, 4, t, (0, 0.3, 1))]
    beams.append(Beam(4, 5, s, (0, 0, 1)))
    masses = [PointMass(5, 0.4, (1e-3, 2e-3, 1.5e-3), (0.02, -0.01, 0.03)), PointMass(0, 2.0, offset=(0.1, 0, 0))]
    return Frame(nodes, beams, masses, mass)


PORTAL_SENSORS = [(2, "x"), (4, (1, 1, 0)), (3, "-y"), (5, (0.3, -0.5, 0.8)), (5, "x"), (4, "rz")]


def fixed_frequencies(frame, n_base_dofs=6):
    """All natural frequencies in rad/s with the first node(s) fixed."""
    mass, stiffness = frame.matrices()
    free = slice(n_base_dofs, None)
    return np.sqrt(scipy.linalg.eigvalsh(stiffness[free, free], mass[free, free]))


def nearest(values, wanted):
    return np.array([values[np.argmin(abs(values - w))] for w in np.atleast_1d(wanted)])


# ---------------------------------------------------------------------------- frequencies


@pytest.mark.parametrize("inertia", ["Iy", "Iz"])
def test_cantilever_frequencies_in_both_planes(inertia):
    exact = BETA_L**2 * np.sqrt(E * {"Iy": IY, "Iz": IZ}[inertia] / (RHO * A * LENGTH**4))
    error = nearest(fixed_frequencies(cantilever(12)), exact) / exact - 1
    # Dispersion of the cubic beam: w_h / w = 1 + (beta h)^4 / 1440 (Strang and Fix, 1973, section 6.3).
    np.testing.assert_allclose(error, (BETA_L / 12) ** 4 / 1440, rtol=0.05)


def test_consistent_mass_converges_with_the_fourth_power():
    exact = BETA_L[:2] ** 2 * np.sqrt(E * IZ / (RHO * A * LENGTH**4))
    errors = [nearest(fixed_frequencies(cantilever(n)), exact) / exact - 1 for n in (4, 8, 16)]
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(order, 4.0, atol=0.15)


def test_lumped_mass_converges_with_the_second_power():
    exact = BETA_L[:2] ** 2 * np.sqrt(E * IZ / (RHO * A * LENGTH**4))
    errors = [abs(nearest(fixed_frequencies(cantilever(n, mass="lumped")), exact) / exact - 1) for n in (10, 20, 40)]
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(errors[-1] < 2e-3)
    np.testing.assert_allclose(order, 2.0, atol=0.2)


@pytest.mark.parametrize(("mass", "sign"), [("consistent", 1), ("lumped", -1)])
def test_axial_and_torsional_rod(mass, sign):
    n = 20
    modes = (2 * np.arange(1, 4) - 1) * np.pi / 2
    found = fixed_frequencies(cantilever(n, mass=mass))
    for speed in (np.sqrt(E / RHO), np.sqrt(G * J / (RHO * (IY + IZ)))):
        exact = modes * speed / LENGTH
        # Linear rods err by (k h)²/24, from above with consistent mass and from below with lumped.
        error = nearest(found, exact * (1 + sign * (modes / n) ** 2 / 24)) / exact - 1
        np.testing.assert_allclose(error, sign * (modes / n) ** 2 / 24, rtol=0.03)


def test_tip_mass_cantilever_transcendental_equation():
    ratio = 0.7
    tip = ratio * RHO * A * LENGTH

    def equation(x):
        c, s, ch, sh = np.cos(x), np.sin(x), np.cosh(x), np.sinh(x)
        return 1 + c * ch + ratio * x * (c * sh - s * ch)

    roots = np.array([scipy.optimize.brentq(equation, *b, xtol=1e-14) for b in ((0.5, 1.8), (3, 4.6), (6, 7.8))])
    exact = roots**2 * np.sqrt(E * IZ / (RHO * A * LENGTH**4))
    found = fixed_frequencies(cantilever(16, point_masses=[PointMass(16, tip)]))
    error = nearest(found, exact) / exact - 1
    assert np.all(error > -1e-9)  # a Rayleigh quotient on a subspace
    assert np.all(error < 1.1 * (roots / 16) ** 4 / 1440 + 1e-9)


def test_rigid_body_on_a_massless_cantilever_with_offset_and_inertia():
    """One plane, two motions at the tip: the 2 x 2 problem in closed form, moved to the centre of mass."""
    m, inertia, arm = 3.0, 0.02, 0.15
    body = PointMass(3, m, np.diag([0.01, 0.01, inertia]), (arm, 0, 0))
    frame = cantilever(3, density=0.0, Iy=1e6 * IY, J=1e4 * J, point_masses=[body])  # the plane of y is the soft one
    flex = np.array([[LENGTH**3 / 3, LENGTH**2 / 2], [LENGTH**2 / 2, LENGTH]]) / (E * IZ)
    mass = np.array([[m, m * arm], [m * arm, inertia + m * arm**2]])
    exact = np.sqrt(1 / np.linalg.eigvals(flex @ mass)) / (2 * np.pi)
    for condensation in ("static", "modal"):
        bar = frame.structure([(3, "y"), (3, "rz")], 0.01, base_nodes=0, base_axes="y", condensation=condensation)
        np.testing.assert_allclose(bar.natural_frequencies, np.sort(exact), rtol=1e-9)


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_turning_the_whole_frame_leaves_its_frequencies(mass):
    here, turned = cantilever(5, mass=mass), cantilever(5, mass=mass, turn=rotation())
    np.testing.assert_allclose(fixed_frequencies(turned), fixed_frequencies(here), rtol=1e-9)


def test_orientation_chooses_the_plane_of_bending():
    nodes = [[0, 0, 0], [0, 0, LENGTH]]
    for orientation, inertia_x in (((1, 0, 0), IZ), ((0, 1, 0), IY), ((1, 0, 5), IZ)):
        frame = Frame(nodes, [Beam(0, 1, section(), orientation)])
        _, stiffness, _ = frame.condense([(1, "x")], base_nodes=[0])
        np.testing.assert_allclose(stiffness[0, 0], 3 * E * inertia_x / LENGTH**3, rtol=1e-12)


# ---------------------------------------------------------------------------- statics


def test_tip_load_deflection_and_rotation():
    _, stiffness, _ = cantilever(7).condense([(7, "y"), (7, "z"), (7, "rz"), (7, "ry")], base_nodes=0)
    flexibility = np.linalg.inv(stiffness[:4, :4])
    load = 10.0
    expected = [load * LENGTH**3 / (3 * E * IZ), 0, load * LENGTH**2 / (2 * E * IZ), 0]
    np.testing.assert_allclose(load * flexibility[0], expected, rtol=1e-9, atol=1e-15)
    expected = [0, load * LENGTH**3 / (3 * E * IY), 0, -load * LENGTH**2 / (2 * E * IY)]
    np.testing.assert_allclose(load * flexibility[1], expected, rtol=1e-9, atol=1e-15)


def test_portal_sway_stiffness():
    """Clamped portal, height h, span b, equal EI, inextensible: k = 24 EI/h³ (1 + 6 r)/(4 + 6 r), r = h/b."""
    h, b = 0.5, 0.8
    stiff = section(A=1e3 * A)
    frame = Frame(
        [[0, 0, 0], [0, 0, h], [b, 0, h], [b, 0, 0]],
        [Beam(0, 1, stiff, (1, 0, 0)), Beam(1, 2, stiff, (0, 0, 1)), Beam(3, 2, stiff, (1, 0, 0))],
    )
    _, stiffness, _ = frame.condense([(1, "x")], base_nodes=[0, 3])
    r = h / b
    assert stiffness[0, 0] == pytest.approx(24 * E * IZ / h**3 * (1 + 6 * r) / (4 + 6 * r), rel=1e-5)


# ---------------------------------------------------------------------------- rigid bodies


def all_rigid_motions(frame, origin=(0, 0, 0)):
    """Written out node by node: u = u_0 + theta × (r - origin)."""
    columns = []
    for axis in range(6):
        shift = np.eye(3)[axis] if axis < 3 else np.zeros(3)
        theta = np.eye(3)[axis - 3] if axis >= 3 else np.zeros(3)
        columns.append(np.concatenate([[*(shift + np.cross(theta, r - origin)), *theta] for r in frame.nodes]))
    return np.array(columns).T


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_stiffness_null_space_is_the_six_rigid_motions(mass):
    frame = portal(mass)
    full_mass, stiffness = frame.matrices()
    motions = all_rigid_motions(frame)
    assert abs(stiffness @ motions).max() < 1e-12 * abs(stiffness).max()
    scale = np.sqrt(np.diag(stiffness))
    eigenvalues = np.linalg.eigvalsh(stiffness / np.outer(scale, scale))
    assert np.sum(eigenvalues < 1e-9) == 6
    for matrix in (full_mass, stiffness):
        np.testing.assert_array_equal(matrix, matrix.T)


@pytest.mark.parametrize("mass", ["consistent", "lumped"])
@pytest.mark.parametrize("condensation", ["static", "modal"])
def test_rigid_body_mass_is_the_total_mass(mass, condensation):
    frame = portal(mass)
    total = 2.4 + sum(
        RHO * b.section.A * np.linalg.norm(frame.nodes[b.end] - frame.nodes[b.start]) for b in frame.beams
    )
    M, _, rigid = frame.condense(PORTAL_SENSORS, base_nodes=[0, 1], condensation=condensation)
    motion = np.vstack([rigid, np.eye(3)])
    np.testing.assert_allclose(motion.T @ M @ motion, total * np.eye(3), rtol=1e-12, atol=1e-11 * total)


def slender_rods(frame, origin):
    """Inertia about `origin` of rods, rho Ip along their axes included, and bodies: textbook formulae."""
    inertia = np.zeros((3, 3))

    def about(m, r):
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    for b in frame.beams:
        start, end = np.asarray(frame.nodes[b.start]), np.asarray(frame.nodes[b.end])
        m, span = RHO * b.section.A * np.linalg.norm(end - start), end - start
        along = span / np.linalg.norm(span)
        inertia += about(m, (start + end) / 2 - origin) + about(m / 12, span)
        inertia += RHO * (IY + IZ) * np.linalg.norm(span) * np.outer(along, along)
    for p in frame.point_masses:
        inertia += about(p.mass, np.asarray(frame.nodes[p.node]) + p.offset - origin)
        if p.inertia is not None:
            inertia += np.diag([p.inertia[i, i] for i in range(3)])
    return inertia


def test_rigid_body_inertia_about_the_origin_is_exact_for_consistent_mass():
    frame, origin = portal(), np.array([0.3, -0.2, 0.1])
    M, _, rigid = frame.condense(PORTAL_SENSORS, base_nodes=[0, 1], base_axes="xyz rx ry rz", origin=origin)
    motion = np.vstack([rigid, np.eye(6)])
    np.testing.assert_allclose((motion.T @ M @ motion)[3:, 3:], slender_rods(frame, origin), rtol=1e-10, atol=1e-10)


def test_rigid_body_inertia_of_lumped_mass_exceeds_the_rods_by_its_stated_terms():
    """Half masses at the ends: m L²/4 instead of m L²/12 about the centre, and 2 m L²/78 of rotary terms."""
    n = 4
    M, _, rigid = cantilever(n, mass="lumped").condense([(n, "y")], base_nodes=0, base_axes="rz")
    m, h = RHO * A * LENGTH, LENGTH / n
    found = np.array([rigid[0, 0], 1]) @ M @ [rigid[0, 0], 1]
    assert found == pytest.approx(m * LENGTH**2 / 3 + m * h**2 * (1 / 4 - 1 / 12 + 2 / 78), rel=1e-12)


def test_rigid_body_matrix_is_geometry():
    frame, origin = portal(), np.array([0.1, 0.2, -0.3])
    _, _, G6 = frame.condense(
        PORTAL_SENSORS, base_nodes=[0, 1], base_axes=["x", "y", "z", "rx", "ry", "rz"], origin=origin
    )
    positions, axes = frame.sensor_geometry(PORTAL_SENSORS[:-1])
    np.testing.assert_allclose(G6[:-1], np.hstack([axes, np.cross(positions - origin, axes)]), atol=1e-15)
    np.testing.assert_array_equal(G6[-1], [0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
    np.testing.assert_array_equal(positions[3], frame.nodes[5])
    _, _, G2 = frame.condense(PORTAL_SENSORS, base_nodes=[0, 1], base_axes="zry", origin=origin)
    np.testing.assert_array_equal(G2, G6[:, [2, 4]])


def test_rigid_body_matrix_agrees_with_the_sensors_of_a_measurement():
    frame = portal()
    choice = {"base_axes": "y, rx rz", "origin": (0.2, 0.1, 0.0)}
    _, _, mine = frame.condense(PORTAL_SENSORS[:-1], base_nodes=[0, 1], **choice)
    np.testing.assert_allclose(mine, rigid_body(*frame.sensor_geometry(PORTAL_SENSORS[:-1]), **choice), atol=1e-15)


# ---------------------------------------------------------------------------- condensation


def test_condensed_flexibility_is_the_frames_own():
    frame = portal()
    M, K, _ = frame.condense(PORTAL_SENSORS, base_nodes=[0, 1], base_axes="xz")
    _, full = frame.matrices()
    rows = np.zeros((6, 36))
    for row, (node, axis) in zip(rows, PORTAL_SENSORS, strict=True):
        named = {"x": (0, 1), "-y": (1, -1), "rz": (5, 1)}
        if isinstance(axis, str):
            row[6 * node + named[axis][0]] = named[axis][1]
        else:
            row[6 * node : 6 * node + 3] = np.array(axis) / np.linalg.norm(axis)
    flexibility = rows[:, 12:] @ np.linalg.solve(full[12:, 12:], rows[:, 12:].T)
    np.testing.assert_allclose(np.linalg.inv(K[:6, :6]), flexibility, rtol=1e-8, atol=1e-12 * abs(flexibility).max())
    scale = np.sqrt(np.diag(M))
    assert np.linalg.eigvalsh(M / np.outer(scale, scale))[0] > -1e-12
    assert np.linalg.matrix_rank(K, tol=1e-9 * np.linalg.norm(K)) == 6


def test_choosing_every_motion_gives_back_the_frame():
    """With each degree of freedom a sensor nothing is condensed."""
    frame = cantilever(3, turn=rotation())
    sensors = [(node, axis) for node in (1, 2, 3) for axis in ("x", "y", "z", "rx", "ry", "rz")]
    full_mass, full_stiffness = frame.matrices()
    for condensation in ("static", "modal"):
        M, K, _ = frame.condense(
            sensors, base_nodes=[0], base_axes="x y z rx ry rz", origin=frame.nodes[0], condensation=condensation
        )
        order = [*range(6, 24), *range(6)]
        size = np.sqrt(np.diag(full_mass))[order]
        np.testing.assert_allclose(
            M / np.outer(size, size), full_mass[np.ix_(order, order)] / np.outer(size, size), atol=1e-8
        )
        size = np.sqrt(np.diag(full_stiffness))[order]
        target = full_stiffness[np.ix_(order, order)]
        np.testing.assert_allclose(K / np.outer(size, size), target / np.outer(size, size), atol=1e-8)


def test_guyan_frequencies_come_from_above_and_modal_ones_are_exact():
    frame = portal()
    exact = fixed_frequencies(frame, 12)[:6] / (2 * np.pi)
    static = frame.structure(PORTAL_SENSORS, 0.01, base_nodes=[0, 1]).natural_frequencies
    modal = frame.structure(PORTAL_SENSORS, 0.01, base_nodes=[0, 1], condensation="modal").natural_frequencies
    assert np.all(static > exact * (1 - 1e-10))
    assert static[0] / exact[0] < 1.01
    np.testing.assert_allclose(modal, exact, rtol=1e-7)


def full_transmissibility(frame, rows, base_column, freq, ratio, n_modes=None):
    """Modal sum over the frame's own modes (all, or the lowest), base nodes 0 and 1."""
    mass, stiffness = frame.matrices()
    lam, phi = scipy.linalg.eigh(stiffness[12:, 12:], mass[12:, 12:])
    lam, phi = lam[:n_modes], phi[:, :n_modes]
    motion = all_rigid_motions(frame)[:, base_column]
    gamma = phi.T @ (mass @ motion)[12:]
    w = 2 * np.pi * freq
    g = w**2 / (lam[:, None] - w**2 + 2j * ratio * np.sqrt(lam[:, None]) * w)
    force = motion @ mass @ motion + (gamma**2) @ g
    return (rows[:, 12:] @ phi * gamma) @ g + (rows @ motion)[:, None], force


def test_modal_condensation_answers_as_the_lowest_modes_of_the_frame():
    frame = portal()
    freq = np.linspace(1.0, 120.0, 40)
    rows = np.zeros((4, 36))
    rows[range(4), [12, 25, 31, 32]] = 1.0
    sensors = [(2, "x"), (4, "y"), (5, "y"), (5, "z")]
    small = frame.structure(sensors, 0.02, base_nodes=[0, 1], base_axes="y", condensation="modal")
    response, force = full_transmissibility(frame, rows, 1, freq, 0.02, n_modes=4)
    np.testing.assert_allclose(small.transmissibility(freq)[:, 0], response, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(small.base_force(freq)[0, 0], force, rtol=1e-6)


def test_structure_carries_descriptions_and_ratios():
    frame, described = cantilever(4), (Sensor("mid", (0, 0, 0), "y"), Sensor("tip", (1, 0, 0), "y"))
    bar = frame.structure([(2, "y"), (4, "y")], [0.01, 0.03], base_nodes=[0], descriptions=described)
    assert bar.sensors == described
    np.testing.assert_array_equal(bar.damping_ratios, [0.01, 0.03])
    assert bar.rigid_body.shape == (2, 3)


# ---------------------------------------------------------------------------- expressions


def parametric(young, density, tip, swing):
    nodes = [[0, 0, 0], [0.5, 0, 0.1], [0.9, 0.2, 0.1], [0.9, 0.2, 0.5]]
    soft, plain = section(E=young, density=density, Iz=2 * IZ), section()
    beams = [Beam(0, 1, soft, (0, 1, 0)), Beam(1, 2, plain, (0, 0, 1)), Beam(2, 3, soft, (1, 0, 0))]
    return Frame(nodes, beams, [PointMass(3, tip, (swing, 1e-4, 2e-4), (0.01, 0.0, 0.02))])


POINT = np.array([60e9, 3000.0, 0.5, 3e-4])
CHOICE = {"base_nodes": [0], "base_axes": "xzry", "origin": (0.1, 0, 0)}
FEW = [(1, "z"), (2, (1, 2, 0)), (3, "x"), (3, "ry")]


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_expressions_equal_numbers_and_their_derivative_equals_differences(kind):
    x = kind.sym("x", 4)
    frame = parametric(x[0], x[1], x[2], x[3])
    full = frame.matrices()
    small = frame.condense(FEW, **CHOICE)
    assert all(isinstance(matrix, kind) for matrix in (*full, *small[:2]))
    assert isinstance(small[2], np.ndarray)
    evaluate = ca.Function("evaluate", [x], [*full, *small[:2]])
    numeric = parametric(*POINT)
    for found, expected in zip(
        evaluate(POINT), (*numeric.matrices(), *numeric.condense(FEW, **CHOICE)[:2]), strict=True
    ):
        np.testing.assert_allclose(found.full(), expected, rtol=1e-9, atol=1e-12 * abs(expected).max())

    slopes = [ca.Function("d", [x], [ca.jacobian(ca.vec(matrix), x)])(POINT).full() for matrix in small[:2]]
    for k in range(4):
        step = 1e-4 * POINT * (np.arange(4) == k)
        above, below = (parametric(*(POINT + s * step)).condense(FEW, **CHOICE) for s in (1, -1))
        for slope, up, down in zip(slopes, above[:2], below[:2], strict=True):
            difference = (up - down) / (2 * step[k])
            size = max(abs(difference).max(), 1e-9 * abs(up).max() / POINT[k])
            np.testing.assert_allclose(slope[:, k].reshape(up.shape, order="F"), difference, atol=1e-6 * size)


def test_a_matrix_without_the_symbol_stays_numbers():
    tip = ca.SX.sym("tip")
    M, K, _ = parametric(POINT[0], POINT[1], tip, POINT[3]).condense(FEW, **CHOICE)
    assert isinstance(M, ca.SX)
    assert isinstance(K, np.ndarray)
    M, K, _ = parametric(ca.MX.sym("E"), *POINT[1:]).condense(FEW, **CHOICE)
    assert isinstance(M, ca.MX)  # through the static shapes
    assert isinstance(K, ca.MX)


def test_inertia_in_all_its_forms():
    values = [1e-3, 2e-3, 2.5e-3]
    forms = [values, np.diag(values), np.diag(values).tolist(), ca.SX(values), ca.SX(np.diag(values)), ca.DM(values)]
    nodes = [[0, 0, 0], [1, 0, 0]]
    expected = None
    for form in forms:
        mass, _ = Frame(nodes, [Beam(0, 1, section(), (0, 1, 0))], [PointMass(1, 1.0, form)]).matrices()
        mass = mass if isinstance(mass, np.ndarray) else ca.DM(mass).full()
        np.testing.assert_allclose(np.diag(mass)[9:] - np.diag(mass)[3:6], values, rtol=1e-9)
        expected = mass if expected is None else expected
        np.testing.assert_allclose(mass, expected, rtol=1e-14)
    skew = [[2e-3, 1e-4, 0], [1e-4, 2e-3, 3e-4], [0, 3e-4, 2e-3]]
    mass, _ = Frame(nodes, [], [PointMass(1, 1.0, skew)]).matrices()
    np.testing.assert_array_equal(mass[9:, 9:], skew)


# ---------------------------------------------------------------------------- mistakes

ONE = [Beam(0, 1, section(), (0, 1, 0))]
TWO_NODES = [[0, 0, 0], [1, 0, 0]]


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: Frame(TWO_NODES, [Beam(0, 2, section(), (0, 1, 0))]), "node 2"),
        (lambda: Frame(TWO_NODES, [Beam(-1, 1, section(), (0, 1, 0))]), "node -1"),
        (lambda: Frame(TWO_NODES, ONE, [PointMass(5, 1.0)]), "node 5"),
        (lambda: Frame([[0, 0, 0], [0, 0, 0]], ONE), "zero length"),
        (lambda: Frame(TWO_NODES, [Beam(0, 1, section(), (-2, 0, 0))]), "parallel"),
        (lambda: Frame(TWO_NODES, [Beam(0, 1, section(), (0, 0, 0))]), "zero vector"),
        (lambda: Frame([[0, 0], [1, 0]], ONE), r"\(N, 3\)"),
        (lambda: Frame([[0, 0, 0], [1, 0, np.nan]], ONE), "finite"),
        (lambda: Frame(TWO_NODES, ONE, mass="diagonal"), "lumped"),
        (lambda: section(A=-1.0), "A must be positive"),
        (lambda: section(J=0), "J must be positive"),
        (lambda: section(density=-1), "density must be at least zero"),
        (lambda: section(E="steel"), "number or a CasADi scalar"),
        (lambda: section(E=ca.SX.sym("E", 2)), "number or a CasADi scalar"),
        (lambda: section(E=np.inf), "finite"),
        (lambda: PointMass(1, -1.0), "at least zero"),
        (lambda: PointMass(1, 1.0, (1, 1, -1)), "semidefinite"),
        (lambda: PointMass(1, 1.0, [[1, 2, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
        (lambda: PointMass(1, 1.0, (1, 2)), "three values"),
        (lambda: PointMass(1, 1.0, offset=(1, 2)), "three finite numbers"),
        (
            lambda: Frame(TWO_NODES, [Beam(0, 1, section(E=ca.SX.sym("E"), G=ca.MX.sym("G")), (0, 1, 0))]).matrices(),
            "mix",
        ),
    ],
)
def test_mistakes_in_a_frame_are_named(build, says):
    with pytest.raises(InputError, match=says):
        build()


@pytest.mark.parametrize(
    ("sensors", "choices", "says"),
    [
        ([(0, "x")], {}, "base node 0"),
        ([(9, "x")], {}, "node 9"),
        ([(1, "q")], {}, "axis of sensor 0"),
        ([(1, (0, 0, 0))], {}, "zero vector"),
        ([], {}, "empty"),
        ([1], {}, "pair"),
        ([(1, "x"), (2, "x"), (1, "-x")], {}, "sensor 2 measures what"),
        ([(1, "x"), (1, "y"), (1, (1, 1, 0))], {}, "sensor 2 measures what"),
        ([(1, "x")], {"base_nodes": []}, "empty"),
        ([(1, "x")], {"base_nodes": [4]}, "the base is on node 4"),
        ([(1, "x")], {"base_axes": "xq"}, "base_axes"),
        ([(1, "x")], {"base_axes": "xyx"}, "twice"),
        ([(1, "x")], {"condensation": "dynamic"}, "condensation"),
        # The lowest two modes bend in z (the weak axis); sensors along x and y are blind to them.
        ([(2, "x"), (2, "y")], {"condensation": "modal"}, "apart"),
    ],
)
def test_mistakes_in_a_condensation_are_named(sensors, choices, says):
    frame = cantilever(2, Iy=IY / 100)
    with pytest.raises(InputError, match=says):
        frame.condense(sensors, **({"base_nodes": [0]} | choices))


def test_a_part_that_hangs_on_nothing_is_a_mechanism():
    nodes = [*TWO_NODES, [0, 1, 0], [1, 1, 0]]
    frame = Frame(nodes, [*ONE, Beam(2, 3, section(), (0, 1, 1))])
    with pytest.raises(InputError, match="mechanism: no beams join node 2"):
        frame.condense([(1, "y")], base_nodes=[0])
    frame.condense([(1, "y")], base_nodes=[0, 2])


def test_modal_condensation_refuses_more_sensors_than_modes():
    frame = cantilever(2, density=0.0, point_masses=[PointMass(2, 1.0)])
    with pytest.raises(InputError, match="fewer than 4 modes"):
        frame.condense([(1, "y"), (2, "y"), (2, "z"), (2, "x")], base_nodes=[0], condensation="modal")


def test_a_structure_needs_numbers_and_geometry_needs_translations():
    frame = parametric(ca.SX.sym("E"), *POINT[1:])
    with pytest.raises(InputError, match="CasADi expression"):
        frame.structure(FEW, 0.01, base_nodes=[0])
    with pytest.raises(InputError, match="modal"):
        frame.condense(FEW, base_nodes=[0], condensation="modal")
    with pytest.raises(InputError, match="sensor 3 measures a rotation"):
        frame.sensor_geometry(FEW)

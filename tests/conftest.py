"""Random structures that the tests share, built from modes and geometry: their properties are known beforehand."""

import contextlib
import gc
import importlib.util
import os
import signal
import sys
from pathlib import Path

# Before NumPy loads it, and for every process that a test starts: OpenBLAS's own threads wait for each other in loops
# that use processor time, and its products here are too small to gain from them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest

import sysid
from sysid.modal_analysis import fit
from sysid.modal_analysis.delays import Delays
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.models.model import Geometry
from sysid.search.continuation import Continuation


def _import_benchmarks():
    """Make ``benchmarks`` importable, which simulates records, but no sysid beside it: that is the installed one."""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    spec = importlib.util.spec_from_file_location(
        "benchmarks", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    sys.modules["benchmarks"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["benchmarks"])


_import_benchmarks()

# Python looks through all objects for cycles after each 700 new ones, here among those of six thousand tests.
gc.set_threshold(20_000, 20, 20)


def pytest_collection_finish(session):
    """Look through what stays to the end no more."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def ctrl_c():
    """Python's own answer to Ctrl-C, also where the tests run in the background of a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def no_pictures(monkeypatch):
    """Leave the pictures of a report out, which take most of its time."""
    from sysid.report import report

    monkeypatch.setattr(
        report, "picture", lambda figure, alt, caption="", *, label="", **_: f"<p>{label} {caption}</p>"
    )


@pytest.fixture
def no_other_answers(monkeypatch):
    """Look for no other structures that explain the records as well, which takes as long as all else."""
    monkeypatch.setattr("sysid.results.judgement.with_other_answers", lambda problem, end, session: end)


@pytest.fixture(scope="module", autouse=True)
def estimates_at_once(request):
    """Look for no delays and for no errors that grow with the signal where tests are of what follows an estimate.

    That takes a quarter of an identification from spectra, and nine tenths where exact ones miss a model. The whole
    is tested in tests/behaviour/, the two in tests/modal_analysis/.
    """
    after = "compare", "export", "jobs", "models", "plot", "problem", "report", "results", "search"
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name in after:
            patch.setattr("sysid.modal_analysis.delays.find_delays", lambda test, beside: Delays.none(test))
        if request.path.parent.name in (*after, "assessment"):
            patch.setattr("sysid.modal_analysis.fit.errors_grow", lambda test, poles: False)
        yield


@pytest.fixture
def no_growing_errors(monkeypatch):
    """Take what is left of exact records for no errors that grow with the signal: their fit takes ten times as long."""
    monkeypatch.setattr("sysid.modal_analysis.fit.errors_grow", lambda test, poles: False)


@contextlib.contextmanager
def _from_one_start():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Continuation.__init__, "__defaults__", (1,))
        patch.setattr("sysid.results.judgement.with_other_answers", lambda problem, end, session: end)
        patch.setattr("sysid.modal_analysis.delays.find_delays", lambda test, beside: Delays.none(test))
        patch.setattr("sysid.modal_analysis.fit.errors_grow", lambda test, poles: False)
        yield


@pytest.fixture(scope="session")
def from_one_start():
    """Give a context: "auto" begins at the guess alone; other answers, delays, growing errors are not looked for.

    That takes a third of the time, and a tenth where exact records miss a model: what is left of them grows with the
    signal. Several starts are tested in tests/search/test_continuation.py and, on bundled problems, in
    test_reference.py; other answers in tests/search/test_other_answers.py, delays and errors that grow with the signal
    in tests/modal_analysis/test_delays.py and test_growing_errors.py.
    """
    return _from_one_start


@pytest.fixture(scope="module")
def from_one_start_in_module():
    """The same for all tests of a module, and for its fixtures."""
    with _from_one_start():
        yield


@pytest.fixture(scope="module")
def fitted_once():
    """Fit whole records that several tests of a module identify once: gives the function that does, `whole_fit`."""
    fits, of = {}, fit.whole_fit

    def once(test, delays=None, *, monitor=None):
        if id(test) not in fits:
            fits[id(test)] = test, of(test, delays)  # the test too, so that no other one gets its place in memory
        return fits[id(test)][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "whole_fit", once)
        yield once


def _geometry(rng, n, d):
    """Rows [e', (r x e)'] of n sensors at random places along random axes, the first d columns."""
    r, e = rng.uniform(-1, 2, (n, 3)), rng.normal(size=(n, 3))
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    return np.hstack([e, np.cross(r, e)])[:, :d]


def _orthogonal(rng, n):
    q, r = np.linalg.qr(rng.normal(size=(n, n)))
    return q * np.sign(np.diag(r))


def _blocks(rng, n, d, *, frequencies=None, base_mass=1.0, G=None):
    """Full M, K and G: M_SS well conditioned, frequencies as asked, M_00 its least plus base_mass · (a random SPD)."""
    G = _geometry(rng, n, d) if G is None else G
    if frequencies is None:
        frequencies = np.sort(rng.uniform(4, 60, n))
    q = _orthogonal(rng, n)
    M_SS = (q * rng.uniform(0.5, 3, n)) @ q.T
    L = np.linalg.cholesky(M_SS)
    half = L @ _orthogonal(rng, n)
    K_SS = (half * (2 * np.pi * np.asarray(frequencies)) ** 2) @ half.T
    M_S0 = 0.3 * rng.normal(size=(n, d))
    w = rng.normal(size=(d, d))
    M_00 = M_S0.T @ np.linalg.solve(M_SS, M_S0) + base_mass * (w @ w.T + 0.1 * np.eye(d))
    M = np.block([[M_SS, M_S0], [M_S0.T, M_00]])
    K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
    return (M + M.T) / 2, (K + K.T) / 2, G


def _structure(rng, n=4, d=2, *, damping="ratios", ratios=None, **options):
    """A random `sysid.Structure`; damping "ratios", or "matrix": dampers that couple the modes."""
    M, K, _ = _blocks(rng, n, d, **options)
    if damping == "ratios":
        return sysid.Structure(M, K, rng.uniform(0.006, 0.04, n) if ratios is None else ratios, n_base=d)
    L = np.linalg.cholesky(M[:n, :n])
    x = L @ rng.normal(size=(n, n))
    C = x @ x.T * 2 * 0.02 * 2 * np.pi * 20 / n + 1e-4 * K[:n, :n]
    return sysid.Structure(M, K, n_base=d, damping_matrix=(C + C.T) / 2)


def _chain(springs, groups, G):
    """K of springs in series, one chain a direction, over sensors and base."""
    n = len(springs)
    T = np.zeros((n, n + G.shape[1]))
    for i in range(n):
        below = [j for j in range(i) if groups[j] == groups[i]]
        T[i, i] = 1.0
        if below:
            T[i, below[-1]] = -1.0
        else:
            T[i, n:] = -G[i]
    return T.T @ np.diag(springs) @ T


def _case(rng, mass="trace", stiffness="spectral", damping="modal", *, n=4, d=2, force=False, total=True, noise=0.0):
    """A truth that the named models can hold, its simulated test, and the problem: (truth, problem).

    `mass`: "trace" or "rigid_body" (a full mass and that healing), "lumped", "known"; `stiffness`: "spectral", "chain";
    `damping`: "modal", "proportional".
    """
    groups = np.arange(n) % d
    along = mass == "lumped" or stiffness == "chain"
    M, K, G = _blocks(rng, n, d, G=np.eye(d)[groups] if along else None)
    if mass == "lumped":
        M = np.diag([*rng.uniform(0.5, 3, n), *np.zeros(d)])
        L = np.sqrt(M[:n, :n])
        half = L @ _orthogonal(rng, n)
        K_SS = (half * (2 * np.pi * np.sort(rng.uniform(4, 60, n))) ** 2) @ half.T
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
    if stiffness == "chain":
        K = _chain(rng.uniform(2e4, 1e5, n), groups, G)
    K = (K + K.T) / 2
    omega = 2 * np.pi * sysid.Structure(M, K, np.zeros(n), n_base=d).natural_frequencies
    ratios = rng.uniform(0.008, 0.03, n)
    if damping == "proportional":
        ratios = rng.uniform(0.5, 2) / (2 * omega) + rng.uniform(5e-5, 2e-4) * omega / 2
    truth = sysid.Structure(M, K, ratios, n_base=d)
    lines = np.geomspace(0.5 * omega[0], 1.2 * omega[-1], 80) / (2 * np.pi)
    test = sysid.simulate(truth, lines, force=force, noise=noise, rng=rng)

    if mass == "lumped":
        model = sysid.LumpedMass([np.diag(M)[:n][groups == i].sum() for i in range(d)] if total else None)
    elif mass == "known":
        model = sysid.KnownMass(M)
    else:
        rigid = np.vstack([G, np.eye(d)])
        strongest = np.argmax(np.abs(rigid), axis=1)
        traces = [np.diag(M)[strongest == i].sum() for i in range(d)]
        stated = {"trace": traces, "rigid_body": np.diag(rigid.T @ M @ rigid)}[mass]
        model = sysid.FullMass(stated if total else None, healing=mass)
    frequencies = truth.natural_frequencies
    stiff = {
        "spectral": sysid.SpectralStiffness(frequencies, max_frequency=1.05 * frequencies[-1]),
        "chain": sysid.ChainStiffness(5e3, 5e5),
    }[stiffness]
    damp = {
        "modal": sysid.ModalDamping(0.005, 0.05), "proportional": sysid.ProportionalDamping((0.0, 5.0), (0.0, 1e-3))
    }[damping]  # fmt: skip
    return truth, sysid.Problem(test, mass=model, stiffness=stiff, damping=damp, reference=truth)


def _geometry_of(G, translational=None, weighed=None):
    """Geometry of a test whose sensors move by `G` (n_sensors, d) with the base; all directions translate."""
    G = np.asarray(G, dtype=float)
    sensors, d = G.shape
    moves, turns = iter(["x", "y", "z"]), iter(["rx", "ry", "rz"])
    axes = [next(moves if moved else turns) for moved in (np.ones(d) if translational is None else translational)]
    test = sysid.Measurement([1.0, 2.0], np.ones((1, d, 2)), np.ones((1, sensors, 2)), rigid_body=G, base_axes=axes)
    return Geometry(ModalEstimate.of_lines(test), weighed=weighed)


@pytest.fixture(scope="session")
def random_case():
    return _case


@pytest.fixture(scope="session")
def random_geometry():
    return _geometry


@pytest.fixture(scope="session")
def random_orthogonal():
    return _orthogonal


@pytest.fixture(scope="session")
def random_blocks():
    return _blocks


@pytest.fixture(scope="session")
def random_structure():
    return _structure


@pytest.fixture(scope="session")
def geometry_of():
    return _geometry_of

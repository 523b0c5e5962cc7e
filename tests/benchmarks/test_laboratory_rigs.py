"""Modes that a structure with a dashpot shows in the lines, against poles and shapes of all its matrices."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def benchmarks():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        names = {"rigs": "laboratory.rigs", "simulated": "records.simulated"}
        return SimpleNamespace(**{name: importlib.import_module(f"benchmarks.{it}") for name, it in names.items()})


@pytest.mark.parametrize("held", [1e-3, 0.3, 1.0, 3.0, 300.0])
def test_modes_shown_are_those_of_the_poles_however_firmly_a_dashpot_holds_its_ends_together(benchmarks, held):
    """Against the one matrix each of damping and stiffness that has the poles and complex shapes of the whole.

    `held` is w c F, with F of the modes above: from a light dashpot to one that damps nothing in the lines.
    """
    omega, stretch = np.array([30.0, 45.0, 400.0, 500.0, 900.0]), np.array([0.01, 0.02, 1.0, -2.0, 3.0])
    size = held / (omega[0] * np.sum((stretch[2:] / omega[2:]) ** 2))
    loss = np.diag(0.02 * omega) + size * np.outer(stretch, stretch)
    modes = benchmarks.simulated.Modes(omega, np.diag(loss) / (2 * omega), np.ones((5, 1)), np.eye(5), np.ones((5, 1)),
                                       np.eye(1))  # fmt: skip
    rig = benchmarks.rigs.Rig("", ("x",), modes, (), 2, loss)
    s, V = np.linalg.eig(np.block([[np.zeros((5, 5)), np.eye(5)], [-np.diag(omega**2), -loss]]))
    own = np.abs(np.abs(s) - 37) < 15
    s, X = s[own & (s.imag != 0)], V[:2, own & (s.imag != 0)]
    C, K = np.split(-(X * s**2 @ np.linalg.inv(np.vstack([X * s, X]))).real, 2, axis=1)
    squares, T = np.linalg.eig(K)
    order = np.argsort(squares)
    w, T = np.sqrt(squares[order]), T[:, order]
    shown = rig.shown
    np.testing.assert_allclose(shown.omega[:2], w, rtol=1e-4)
    np.testing.assert_allclose(shown.zeta[:2], np.diag(np.linalg.inv(T) @ C @ T) / (2 * w), rtol=5e-3)
    shape = shown.shapes[:2, :2]
    np.testing.assert_allclose(shape / np.diag(shape), T / np.diag(T), atol=1e-3)
    if held > 100:
        np.testing.assert_allclose(shown.zeta[:2], 0.01, rtol=0.02)
        assert np.all(modes.zeta[:2] > 0.02)


def test_without_dashpot_modes_are_as_they_are_and_hardly_others_with_a_light_one(benchmarks):
    rng = np.random.default_rng(3)
    rig = benchmarks.rigs.plane(rng)
    assert rig.shown is rig.modes
    light = benchmarks.rigs.with_dashpot(rng, rig)
    light = replace(light, loss=1e-3 * light.loss, modes=replace(light.modes, zeta=1e-3 * light.modes.zeta))
    shown, modes, own = light.shown, light.modes, slice(0, rig.count)
    np.testing.assert_allclose(shown.omega, modes.omega, rtol=1e-5)
    np.testing.assert_allclose(shown.zeta[own], modes.zeta[own], rtol=1e-3)
    np.testing.assert_allclose(shown.shapes, modes.shapes, atol=1e-4 * np.abs(modes.shapes).max())

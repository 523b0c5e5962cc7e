"""The recipes of docs/kinds_of_test.md run as they stand, and end in the judgement that the page states."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from laboratory import save, strong_motion

import sysid
from sysid.cli import main as cli

PAGE = Path(__file__).resolve().parents[2] / "docs/kinds_of_test.md"
pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="no documents beside the tests")
RATE, SECONDS = 40.0, 40.0
MASS, SPRINGS = np.diag([5e3, 4e3]), np.array([[4e6, -2e6], [-2e6, 2e6]])
HEIGHTS = np.array([3.0, 6.0])


def structure(rigid):
    """Two floors of 5 and 4 t, modes at 2.1 and 5.2 Hz, on a base whose unit motions move them by `rigid` (2, d)."""
    d = rigid.shape[1]
    across = SPRINGS @ rigid
    stiffness = np.block([[SPRINGS, -across], [-across.T, rigid.T @ across]])
    mass = np.block([[MASS, np.zeros((2, d))], [np.zeros((d, 2)), np.zeros((d, d))]])
    return sysid.Structure(mass, stiffness, [0.02, 0.03], n_base=d, rigid_body=rigid)


def motion(rng, count=1):
    """Random motion from 1 to 8 Hz, (count, n)."""
    band = scipy.signal.butter(4, (1.0, 8.0), "bandpass", fs=RATE, output="sos")
    return scipy.signal.sosfilt(band, rng.standard_normal((count, int(RATE * SECONDS))), axis=1)


def noisy(rng, rows):
    rows = np.atleast_2d(rows)
    return rows + 0.003 * rows.std(axis=1, keepdims=True) * rng.standard_normal(rows.shape)


def write(name, base, truth, rng, heads):
    channels = np.vstack([base, truth.simulate(base, RATE), truth.simulate_force(base, RATE)])
    save(name, ["time [s]", *heads], [np.arange(base.shape[1]) / RATE, *noisy(rng, channels)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the page names."""
    folder, rng, x = tmp_path_factory.mktemp("kinds"), np.random.default_rng(0), structure(np.ones((2, 1)))
    patch = pytest.MonkeyPatch()
    patch.chdir(folder)
    (folder / "sensors.toml").write_text(re.search(r"```toml\n(.*?)```", PAGE.read_text("utf-8"), re.S)[1], "utf-8")
    heads = ("table [m/s²]", "a1 [m/s²]", "a2 [m/s²]", "force [N]")
    write("random.csv", motion(rng), x, rng, heads)
    time = np.arange(int(RATE * SECONDS)) / RATE
    for name, ends in (("up", (1.0, 8.0)), ("down", (8.0, 1.0))):
        write(f"{name}.csv", scipy.signal.chirp(time, ends[0], SECONDS, ends[1], "log")[None], x, rng, heads)
    freq = np.geomspace(1, 8, 200)
    read = np.vstack([np.ones(200), x.transmissibility(freq)[:, 0], x.base_force(freq)[0]])
    read = read + 0.001 * np.abs(read).mean(axis=1, keepdims=True) * (rng.standard_normal((*read.shape, 2)) @ [1, 1j])
    pairs = [(f"Mag({h.split()[0]}) {h.split()[1]}", f"Phase({h.split()[0]}) [deg]") for h in heads]
    parts = [part for row in read for part in (np.abs(row), np.degrees(np.angle(row)))]
    save("dwell.csv", ["Frequency [Hz]", *(word for pair in pairs for word in pair)], [freq, *parts])
    base = motion(rng) * np.exp(-time / 12)
    strong_motion("building.V2", noisy(rng, np.vstack([base, x.simulate(base, RATE)])), 1 / RATE)
    freq = np.arange(1, 1601) * 0.005
    H, share = x.transmissibility(freq)[:, 0], 1e-4  # of noise in power
    error = np.sqrt(share / 40 / 2) * np.abs(H) * (rng.standard_normal((2, *H.shape)) * [[[1]], [[1j]]]).sum(axis=0)
    columns = [part for row in H + error for part in (row.real, row.imag, np.full(freq.size, 1 - share))]
    named = [f"{name}_{part}" for name in ("h1", "h2") for part in ("re", "im", "coh")]
    save("h1.csv", ["Frequency [Hz]", *named], [freq, *columns])
    tower = np.diag([800.0] * 3 + [0.0] * 3), np.diag([2e5, 3e5, 9e5])
    three = sysid.Structure(tower[0], np.kron([[1, -1], [-1, 1]], tower[1]), [0.02, 0.02, 0.03], n_base=3)
    for axis in range(3):
        base = motion(rng, 3) * np.where(np.arange(3) == axis, 1.0, 0.05)[:, None]
        named = [
            f"{what}_{at} [{unit}]"
            for what, unit in (("table", "m/s²"), ("top", "m/s²"), ("force", "N"))
            for at in "xyz"
        ]
        write(f"{'xyz'[axis]}.csv", base, three, rng, named)
    rocks, base = structure(np.column_stack([np.ones(2), HEIGHTS])), motion(rng, 2) * [[1.0], [0.1]]
    force, moment = rocks.simulate_force(base, RATE)
    turned = 0.4 * base[1]
    rows = [base[0], turned, -turned, *rocks.simulate(base, RATE), force, moment / 0.8, -moment / 0.8]
    named = [f"{one} [m/s²]" for one in ("table", "left", "right", "a1", "a2")]
    named += [f"{one} [N]" for one in ("force", "cell_left", "cell_right")]
    save("rocking.csv", ["time [s]", *named], [time, *noisy(rng, rows)])
    yield folder
    patch.undo()


def recipes():
    """Commands of each section of the page, by its title."""
    text = PAGE.read_text(encoding="utf-8").replace("\\\n", "") if PAGE.exists() else ""
    parts = re.split(r"^## (.*)$", text, flags=re.M)
    found = {
        title: re.findall(r"^sysid (.*)$", part, re.M) for title, part in zip(parts[1::2], parts[2::2], strict=True)
    }
    return [(title, commands) for title, commands in found.items() if commands]


def test_a_recipe_stands_for_each_kind():
    assert len(recipes()) == 7


@pytest.mark.parametrize(("title", "commands"), recipes())
def test_each_recipe_ends_in_the_judgement_that_the_page_states(folder, capsys, no_pictures, title, commands):
    for line in commands:
        assert cli.main(shlex.split(line)) == 0, capsys.readouterr().err
        if line.startswith("run"):
            out = line.split("--out ")[1]
            result = sysid.load(folder / out / "result.h5")
            open_ = out in ("building", "h1")
            assert result.judgement == ("one of many" if open_ else "determined"), [str(one) for one in result.findings]
            f = np.sqrt(2e5 / 800) / (2 * np.pi) if out == "axes" else structure(np.ones((2, 1))).natural_frequencies[0]
            np.testing.assert_allclose(result.structure.natural_frequencies[0], f, rtol=2e-3)


def test_doctor_tells_the_kind_of_each_file(folder, capsys):
    for name, words in (
        ("random.csv", "random"),
        ("up.csv", "swept"),
        ("dwell.csv", "uneven lines"),
        ("h1.csv", "analyser"),
    ):
        assert cli.main(["doctor", name]) in (0, 1)
        assert words in capsys.readouterr().out

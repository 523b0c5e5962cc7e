"""A damaged file is one clear error, whatever the damage, and never numbers that nobody measured."""

import h5py
import numpy as np
import pytest

import sysid
from sysid.finding import Finding, Severity


def result(path):
    """A small identification, stored in today's format; no search has produced it."""
    K = 1e4 * np.array([[3.0, -1.0, -2.0], [-1.0, 1.0, 0.0], [-2.0, 0.0, 2.0]])
    truth = sysid.Structure(np.diag([3.0, 2.0, 0.0]), K, [0.01, 0.02], n_base=1)
    k = sysid.Variable("k", 2, lower=1e3, upper=1e5, guess=[1e4, 2e4], log=True)
    problem = sysid.Problem(
        sysid.simulate(truth, np.linspace(1.0, 40.0, 60), noise=0.01, rng=0), mass=sysid.LumpedMass(5.0),
        stiffness=[[k[0] + k[1], -k[0]], [-k[0], k[0]]], damping=[0.01, 0.02],
    )  # fmt: skip
    findings = (Finding("open", Severity.CAUTION, "all"),)
    made = sysid.Identification(
        truth, problem, np.ones(4), "swarm", 1, sysid.History(log=("one",) * 9), findings
    )  # fmt: skip
    return made.save(path)


def damaged(data, kind, rng):
    """The bytes with another bit in a few places, an end that is missing or too much, or zeros in a block."""
    if kind == "cut":
        return data[: rng.integers(len(data))]
    if kind == "appended":
        return data + rng.bytes(int(rng.integers(1, 600)))
    broken = bytearray(data)
    if kind == "flipped":
        for at in rng.choice(len(data), rng.integers(1, 4), replace=False):
            broken[at] ^= 1 << int(rng.integers(8))
    while broken == data:
        at = int(rng.integers(len(data)))
        size = len(broken[at : at + int(rng.integers(1, 2000))])
        broken[at : at + size] = bytes(size)
    return bytes(broken)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return result(tmp_path_factory.mktemp("sound"))


@pytest.mark.parametrize("kind", ["flipped", "cut", "appended", "zeroed"])
def test_each_of_300_damaged_files_is_refused(sound, kind, tmp_path, monkeypatch):
    """75 a kind, and HDF5 sees none of them."""
    sysid.load(sound)
    monkeypatch.setattr(h5py, "File", None)
    data, rng, path = sound.read_bytes(), np.random.default_rng(0), tmp_path / "damaged.h5"
    for _ in range(75):
        path.write_bytes(damaged(data, kind, rng))
        with pytest.raises(sysid.InputError, match=r"damaged\.h5 cannot be read: it is (damaged|not a result)"):
            sysid.load(path)


def test_a_file_without_its_head_is_no_old_one(sound, tmp_path):
    """Data that HDF5 finds behind the head are not read without the SHA-256 of it."""
    path = tmp_path / "headless.h5"
    for image in (sound.read_bytes()[512:], bytes(512) + sound.read_bytes()[512:]):
        path.write_bytes(image)
        with pytest.raises(sysid.InputError, match="cannot be read"):
            sysid.load(path)

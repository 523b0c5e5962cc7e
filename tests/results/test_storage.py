"""Results on disk: exact, plain, and whole or not at all."""

import dataclasses
import errno
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

import sysid
from sysid.files.tree import from_bytes, to_bytes
from sysid.finding import Finding, Severity
from sysid.models.unknowns import Unknown
from sysid.results import storage


def building(damping_matrix: bool = False, sensors: bool = True, skew: bool = True) -> sysid.Structure:
    """Three masses, two base directions, a random coupling."""
    random = np.random.default_rng(5)
    n, d = 3, 2
    root = random.standard_normal((n + d, n + d))
    mass = root @ root.T + 5 * np.eye(n + d)
    G = np.array([[1.0, 0.0], [0.6, 0.8] if skew else [1.0, 0.0], [0.0, -1.0]])
    spring = random.standard_normal((n, n))
    K = 4e4 * (spring @ spring.T + np.eye(n))
    stiffness = np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])
    described = (
        sysid.Sensor("top, +x", (0.0, 0.0, 3.0), "y"),
        sysid.Sensor("Stütze 2 – schräg", (0.1, 0.2, 2.0), (0.8, 0.6, 0.0) if skew else (0.0, 1.0, 0.0)),
        sysid.Sensor("tip", (0.0, 0.0, 1.0), "-x"),
    )
    return sysid.Structure(
        mass,
        stiffness,
        None if damping_matrix else [0.01, 0.02, 0.015],
        n_base=d,
        damping_matrix=random.uniform(1, 2, 3) * np.eye(n) if damping_matrix else None,
        sensors=described if sensors else None,
    )


MASSES = {
    "full": sysid.FullMass([30.0, 31.0], healing="rigid_body"),
    "full, unknown total": sysid.FullMass(),
    "full, known entries": sysid.FullMass(
        [[30.0, 1.0], [1.0, 31.0]],
        healing="rigid_body",
        known=[[2.0, np.nan, 0.0], [np.nan, np.nan, np.nan], [0.0, np.nan, np.nan]],
    ),
    "lumped": sysid.LumpedMass(12.5),
    "known": sysid.KnownMass(np.diag([1.0, 2.0, 3.0])),
}
STIFFNESSES = {
    "spectral": sysid.SpectralStiffness([10.0, 20.0], max_frequency=90.0),
    "chain": sysid.ChainStiffness(1e3, [1e5, 2e5, 3e5]),
}
DAMPINGS = {
    "modal": sysid.ModalDamping(0.001, 0.1),
    "proportional": sysid.ProportionalDamping((0.0, 0.5), (0.0, 1e-3)),
}


def identification(
    mass: str = "full", stiffness: str = "spectral", damping: str = "modal", **changes: object
) -> sysid.Identification:
    """Make a result that no search has produced, with everything that one can have."""
    truth = building(skew=stiffness != "chain")  # whose sensors point along the base directions
    freq = np.linspace(2.0, 60.0, 40)
    test = sysid.simulate(truth, freq, noise=0.02, force=True, rng=1, base_axes="yx")
    other = sysid.simulate(truth, freq[::2], noise=0.02, rng=2, base_axes="yx")
    problem = sysid.Problem(
        test, mass=MASSES[mass], stiffness=STIFFNESSES[stiffness], damping=DAMPINGS[damping],
        reference=building(damping_matrix=True, sensors=False, skew=stiffness != "chain"),
        validation=[other, test], goal=0.05,
    )  # fmt: skip
    history = sysid.History(
        start=0.9, swarm=0.1 + 0.2, local=1e-300,
        swarm_curve=np.array([0.9, 0.3]), local_curve=np.zeros(0), refinement_error=1e-12,
        states=(("exploration", 3), ("jumping out", 0)), leaders_tried=7, leaders_won=2,
        refinement_statuses=(("Maximum_Iterations_Exceeded", 1), ("Solve_Succeeded", 6)), evaluations=12345,
        wall_time=1.25,
        log=("    0.00 s  swarm – α", "    1.00 s  done"),
    )  # fmt: skip
    made = sysid.Identification(
        truth, problem, np.pi * np.arange(problem.n_variables), "swarm", 2**62 + 1, history,
        (
            Finding("open", Severity.CAUTION, "mode 1 is open"),
            Finding("gain not shown", Severity.NOTE, "degré: β", "remède", 2, "α", {"g": 1.01}),
            Finding("ending", Severity.NOTE, "Solve_Succeeded; ζ"),
        ),
        True, recipe=sysid.Recipe("problems/häuser.py", None, 3),
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def assert_same(a: object, b: object, at: str = "result") -> None:
    """Equal to the bit, through every public attribute."""
    if isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape, at
        assert a.tobytes() == b.tobytes(), at
    elif isinstance(a, sysid.Structure):
        for name in vars(a):
            assert_same(getattr(a, name), getattr(b, name), f"{at}.{name}")
    elif isinstance(a, tuple(type(model) for model in (*MASSES.values(), *STIFFNESSES.values()))):
        assert type(a) is type(b), at
        for field in dataclasses.fields(a):
            mine, other = getattr(a, field.name), getattr(b, field.name)
            if isinstance(mine, str) or mine is None:
                assert mine == other, f"{at}.{field.name}"
            else:  # a list becomes an array
                assert_same(np.asarray(mine, float), np.asarray(other, float), f"{at}.{field.name}")
    elif isinstance(a, Unknown):
        assert_same(a.lower, b.lower, at)
        assert_same(a.upper, b.upper, at)
    elif dataclasses.is_dataclass(a):
        assert type(a) is type(b), at
        for field in dataclasses.fields(a):
            if field.name not in ("site", "prepared"):  # where a problem was put together; what is found anew
                assert_same(getattr(a, field.name), getattr(b, field.name), f"{at}.{field.name}")
    elif isinstance(a, tuple):
        assert isinstance(b, tuple) and len(a) == len(b), at
        for i, (mine, other) in enumerate(zip(a, b, strict=True)):
            assert_same(mine, other, f"{at}[{i}]")
    elif isinstance(a, float) and np.isnan(a):
        assert isinstance(b, float) and np.isnan(b), at
    else:
        assert type(a) is type(b) and a == b, at


@pytest.mark.parametrize("mass", MASSES)
@pytest.mark.parametrize("stiffness", STIFFNESSES)
@pytest.mark.parametrize("damping", DAMPINGS)
def test_round_trip_is_exact_for_every_model(tmp_path, mass, stiffness, damping):
    if "known entries" in mass and (stiffness == "chain" or damping == "proportional"):
        with pytest.raises(sysid.InputError, match="modal strategy only"):
            identification(mass, stiffness, damping)
        return
    original = identification(mass, stiffness, damping)
    assert_same(original, sysid.load(original.save(tmp_path / "a.h5")))


def test_round_trip_keeps_what_is_absent(tmp_path):
    truth = building(damping_matrix=True, sensors=False)
    problem = sysid.Problem(
        sysid.simulate(truth, [1.0, 2.0, 3.0]), mass=sysid.FullMass(), stiffness=STIFFNESSES["spectral"]
    )
    original = identification(
        structure=truth, problem=problem, x=np.zeros(problem.n_variables), seed=None, recipe=None, findings=(),
        interrupted=False, history=sysid.History(),
    )  # fmt: skip
    assert_same(original, sysid.load(original.save(tmp_path / "a.h5")))


def test_round_trip_keeps_a_recovery_to_more_sensors(tmp_path):
    full = building()
    recovery = np.vstack([np.eye(3), [0.5, 0.5, 0.0]])
    G = np.vstack([full.rigid_body, [0.8, 0.4]])
    wide = sysid.Structure(
        full.mass, full.stiffness, full.damping_ratios, n_base=2, recovery=recovery, rigid_body=G, sensors=None
    )
    original = identification(structure=wide)
    assert_same(wide, sysid.load(original.save(tmp_path / "a.h5")).structure)


def test_a_path_is_a_file_or_a_folder(tmp_path):
    original = identification()
    assert original.save(tmp_path / "deep" / "run.v2") == tmp_path / "deep" / "run.v2" / "result.h5"
    assert original.save(str(tmp_path / "x.hdf5")) == tmp_path / "x.hdf5"
    for path in (tmp_path / "deep" / "run.v2", str(tmp_path / "deep" / "run.v2" / "result.h5"), tmp_path / "x.hdf5"):
        assert sysid.load(path).seed == original.seed


def test_a_path_to_write_is_a_file_by_its_ending_or_else_a_folder(tmp_path):
    endings = (".h5", ".hdf5")
    assert storage.file_or_folder(str(tmp_path / "A.HDF5"), "result.h5", endings) == tmp_path / "A.HDF5"
    assert storage.file_or_folder(tmp_path / "run.v2", "result.h5", endings) == tmp_path / "run.v2" / "result.h5"
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(sysid.InputError, match=r"notes.txt is some other file: give a name that ends in \.h5"):
        storage.file_or_folder(tmp_path / "notes.txt", "result.h5", endings)


def test_same_result_same_bytes(tmp_path):
    first, second = (identification().save(tmp_path / name) for name in ("a.h5", "b.h5"))
    assert first.read_bytes() == second.read_bytes()
    again = sysid.load(first).save(tmp_path / "c.h5")
    assert again.read_bytes() == first.read_bytes()


def test_the_file_holds_numbers_and_text_only(tmp_path):
    seen = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        kinds = [value.dtype for value in item.attrs.values() if hasattr(value, "dtype")]
        if isinstance(item, h5py.Dataset):
            kinds.append(item.dtype)
        seen.extend((name, kind) for kind in kinds)

    with h5py.File(identification().save(tmp_path), "r") as file:
        file.visititems(visit)
        assert file.attrs["sysid_version"].decode() == sysid.__version__
        assert file["problem/measurement/response"].dtype == complex
    assert len(seen) > 40
    for name, kind in seen:
        assert kind.kind in "biufcS", name


def test_a_text_keeps_every_character(tmp_path):
    text = "a\nb\t<&\"'> \u2028 \U0001f527 \udcff"
    each = [Finding(kind, severity, told, told, None, told, {text: 1.5, "": np.inf}) for kind, severity, told in (
        ("ending", Severity.NOTE, text), ("open", Severity.CAUTION, ""), ("open", Severity.CAUTION, text),
    )]  # fmt: skip
    original = identification(findings=tuple(each))
    back = sysid.load(original.save(tmp_path))
    assert back.findings == original.findings


def test_a_huge_seed_survives(tmp_path):
    assert sysid.load(identification(seed=2**127 + 1).save(tmp_path)).seed == 2**127 + 1


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, failure):
    path = identification().save(tmp_path)
    before = path.read_bytes()

    write = Path.write_bytes

    def fail(self: Path, data: bytes) -> None:
        write(self, data[: len(data) // 2])
        raise failure("now")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(failure):
        identification(seed=1).save(tmp_path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_stored_leaves_nothing(tmp_path):
    with pytest.raises(sysid.InputError, match="/strategy: a object cannot be stored"):
        identification(strategy=object()).save(tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_each_wrong_file_gets_its_own_sentence(tmp_path):
    good = identification().save(tmp_path / "good.h5").read_bytes()

    with pytest.raises(sysid.InputError, match="no result at"):
        sysid.load(tmp_path / "nowhere.h5")
    with pytest.raises(sysid.InputError, match=r"no result at .*result\.h5"):
        sysid.load(tmp_path)
    with pytest.raises(sysid.InputError, match=f"x cannot be read: {os.strerror(errno.ENAMETOOLONG)}"):
        sysid.load("x" * 5000)
    for name, content, sentence in (
        ("text.h5", b"not this", "it is not a result of sysid"),
        ("empty.h5", b"", "it is not a result of sysid"),
        ("cut.h5", good[:9000], f"it has 9000 bytes, and {len(good)} were written"),
        ("longer.h5", good + b"\0", f"it has {len(good) + 1} bytes, and {len(good)} were written"),
        ("other.h5", good[:-1] + bytes([good[-1] ^ 1]), "its bytes have another SHA-256"),
        ("later.h5", to_bytes({"sysid_version": "9.1"}, 6), r"format 6 \(sysid 9.1\), .* a later sysid is needed"),
        ("records.h5", to_bytes({"content": "sysid test"}, 5), "it holds a sysid test, not a sysid identification"),
        ("earlier.h5", to_bytes({"content": "sysid identification"}, 4), "format 4, .*anew by 'sysid run PROBLEM'"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(sysid.InputError, match=f"{name} cannot be read: .*{sentence}"):
            sysid.load(tmp_path / name)
    with h5py.File(tmp_path / "else.h5", "w") as file:
        file["data"] = [1, 2]
    with pytest.raises(
        sysid.InputError, match=r"else\.h5 .*: it is no result of this sysid, but of one before format 3"
    ):
        sysid.load(tmp_path / "else.h5")


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda tree: tree["structure"].pop("mass"), "KeyError: 'mass'|missing 1 required"),
        (lambda tree: tree.pop("problem"), "KeyError: 'problem'"),
        (
            lambda tree: tree["problem"]["given"]["mass"].update(kind="os:system"),
            "the class 'system' of the module 'os'",
        ),
        (lambda tree: tree["problem"]["measurement"]["freq"].fill(0.0), "freq must rise strictly"),
        (lambda tree: tree["history"].pop("states"), "KeyError: 'states'"),
    ],
)
def test_what_is_sound_but_makes_no_result_is_refused_with_its_name(tmp_path, edit, sentence):
    """Such as a program of somebody else's may write."""
    tree, number = from_bytes(identification().save(tmp_path).read_bytes())
    edit(tree)
    (tmp_path / "edited.h5").write_bytes(to_bytes(tree, number))
    with pytest.raises(sysid.InputError, match=rf"edited\.h5 cannot be read: .*({sentence})"):
        sysid.load(tmp_path / "edited.h5")


def test_a_file_that_was_edited_by_hand_is_refused(tmp_path):
    path = identification().save(tmp_path)
    with h5py.File(path, "r+") as file:
        file["problem/measurement/response"][...] *= 2
    with pytest.raises(sysid.InputError, match=r"result\.h5 cannot be read: it is damaged"):
        sysid.load(path)


def test_a_place_that_cannot_be_written_gets_one_sentence(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(sysid.InputError, match=r"ends in \.h5"):
        identification().save(tmp_path / "notes.txt")
    with pytest.raises(sysid.InputError, match="cannot be written"):
        identification().save(tmp_path / "notes.txt" / "a.h5")
    assert (tmp_path / "notes.txt").read_text() == "mine"

"""Searches that were ended in their midst go on from their checkpoint, and end with the bits they would have had."""

import functools
import time

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.files.tree import from_bytes, to_bytes
from sysid.results.checkpoint import Checkpoint

STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
SHORT = sysid.Swarm(max_iterations=12, restarts=1, n_particles=20)
ENDS = [0.0, 0.5, 1.0]  # shares of a search after which it is killed


class Killed(BaseException):
    """Ends a search as a lost process does: nothing more is written than what was."""


def chain(noise=0.0):
    M, K, C = (np.diag(values) for values in ([5.0, 4.0], [2e4, 1.5e4], [9.0, 6.0]))
    full = np.zeros((3, 3))
    full[:2, :2] = M
    truth = sysid.Structure(full, STRETCH.T @ K @ STRETCH, damping_matrix=(STRETCH.T @ C @ STRETCH)[:2, :2], n_base=1)
    k = sysid.Variable("spring", 2, lower=1e3, upper=1e6, log=True)
    c = sysid.Variable("damper", 2, lower=0.1, upper=500.0, log=True)
    return sysid.Problem(
        sysid.simulate(truth, np.linspace(2.0, 20.0, 60), noise=noise, rng=0), mass=M,
        stiffness=STRETCH.T @ ca.diag(k) @ STRETCH, damping=(STRETCH.T @ ca.diag(c) @ STRETCH)[:2, :2],
    )  # fmt: skip


def free_modes(random_case):
    return random_case(np.random.default_rng(3), "trace", n=3, d=1)[1]


def bits(result):
    """All of a result but times."""
    tree = result.to_tree()
    history = {name: value for name, value in tree["history"].items() if name not in ("wall_time", "log")}
    history["phases"] = [{**phase, "seconds": 0.0} for phase in history["phases"]]
    return to_bytes({**tree, "history": history}, 1)


class Counted:
    """Reports so far, of one phase or of all; with `last` the search is killed after so many."""

    def __init__(self, last=None, phase=""):
        self.count, self.last, self.phase = 0, last, phase

    def __call__(self, progress):
        self.count += self.phase in progress.phase
        if self.count == self.last:
            raise Killed


@pytest.fixture(scope="module")
def uninterrupted():
    """Give a function that searches the chain without noise by a strategy with seed 0: once for all tests."""
    return functools.cache(lambda strategy: sysid.identify(chain(), strategy=strategy, rng=0))


@pytest.mark.parametrize(
    ("form", "strategy", "shares"),
    [("chain", SHORT, [0.5, 1.0]), ("free", SHORT, ENDS),
     ("free", sysid.Swarm(12, local="cholesky", refine_by="leaders"), [0.5, 1.0]),
     ("chain", "auto", [0.5, 1.0]), ("free", "auto", ENDS)],  # of the chain "auto" is continuation
)  # fmt: skip
def test_killed_at_any_report_a_search_goes_on_to_the_same_bits(form, strategy, shares, random_case, tmp_path):
    problem = chain() if form == "chain" else free_modes(random_case)
    all_of_it = Counted()
    whole = sysid.identify(problem, strategy=strategy, rng=4, progress=all_of_it)
    fewer = []
    for last in np.unique([1 + int(share * (all_of_it.count - 1)) for share in shares]):
        checkpoint = Checkpoint(tmp_path / f"{last}.h5", every=0.0)
        with pytest.raises(Killed):
            sysid.identify(problem, strategy=strategy, rng=4, progress=Counted(last), checkpoint=checkpoint)
        rest = Counted()
        again = sysid.identify(problem, strategy=strategy, rng=4, progress=rest, checkpoint=checkpoint.path)
        assert bits(again) == bits(whole)
        assert not checkpoint.exists  # a search that has ended is not unfinished
        fewer.append(all_of_it.count - rest.count)
    if (form, strategy) != ("free", "auto"):  # which is modal, and done at once
        assert fewer[-1] >= 10


def test_ctrl_c_keeps_the_state_at_once_and_the_search_goes_on_from_there(tmp_path, uninterrupted):
    def interrupt(progress):
        if (progress.phase, progress.iteration) == ("swarm", 7):
            raise KeyboardInterrupt

    problem, file = chain(), tmp_path / "state.h5"
    first = sysid.identify(problem, strategy=SHORT, rng=0, callback=interrupt, checkpoint=file)
    assert first.interrupted
    assert file.exists()
    iterations = []
    again = sysid.identify(
        problem, strategy=SHORT, rng=0, checkpoint=file, progress=lambda at: iterations.append((at.phase, at.iteration))
    )
    assert next(at for at in iterations if at[0] == "swarm") == ("swarm", 8)
    assert bits(again) == bits(uninterrupted(SHORT))


def test_a_search_that_fails_by_itself_is_not_unfinished(tmp_path, monkeypatch):
    import sysid.search.continuation as module

    def no_structure(problem, ends):
        raise sysid.SolverError("no search ended at a structure")

    monkeypatch.setattr(module, "_best", no_structure)
    checkpoint = Checkpoint(tmp_path / "state.h5", every=0.0)
    with pytest.raises(sysid.SolverError):
        sysid.identify(chain(), strategy="continuation", rng=0, checkpoint=checkpoint)
    assert not checkpoint.exists


def test_no_failure_that_another_try_may_mend_takes_the_state_away(tmp_path, monkeypatch, state):
    """A full disk at the start of the next run, and a time limit that leaves no time."""
    import sysid.results.checkpoint as module

    file = unfinished(tmp_path / "state.h5", state)
    before = file.read_bytes()

    def full(path):
        raise sysid.InputError(f"{path} cannot be written: no space left")

    with monkeypatch.context() as patch:
        patch.setattr(module, "atomically", full)
        with pytest.raises(sysid.InputError, match="no space left"):
            sysid.identify(chain(), strategy=SHORT, rng=0, checkpoint=file)
    assert file.read_bytes() == before
    with pytest.raises(sysid.SolverError, match="time"):
        sysid.identify(chain(), strategy=SHORT, rng=0, checkpoint=file, max_time=1e-6)
    assert Checkpoint(file).read()["entries"]


def test_what_ran_out_of_time_is_done_again_with_more(tmp_path):
    """Ctrl-C in the last phase of a search whose time was over before: its fits may have ended where no fit ends."""

    def interrupt(progress):
        if progress.phase == "continuation" and progress.seconds < limit:
            time.sleep(limit - progress.seconds)
        if progress.phase == "local phase":
            raise KeyboardInterrupt

    problem, file, limit = chain(), tmp_path / "state.h5", 3.0  # s: what comes before takes one on a busy machine
    strategy = sysid.Continuation(starts=1)
    first = sysid.identify(problem, strategy=strategy, rng=0, max_time=limit, callback=interrupt, checkpoint=file)
    assert first.interrupted
    again = sysid.identify(problem, strategy=strategy, rng=0, checkpoint=file)
    assert bits(again) == bits(sysid.identify(problem, strategy=strategy, rng=0))


def test_a_search_that_had_no_candidate_leaves_nothing(tmp_path):
    def interrupt(progress):
        raise Killed

    with pytest.raises(Killed):
        sysid.identify(chain(), strategy=SHORT, rng=0, callback=interrupt, checkpoint=tmp_path / "a/b/state.h5")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def state(tmp_path_factory):
    """What a search of the chain leaves that is killed after its fourth iteration."""
    path = tmp_path_factory.mktemp("killed") / "state.h5"
    with pytest.raises(Killed):
        sysid.identify(
            chain(), strategy=SHORT, rng=0, callback=Counted(4, "swarm"), checkpoint=Checkpoint(path, every=0.0)
        )
    return path.read_bytes()


def unfinished(path, state):
    path.write_bytes(state)
    return path


def test_the_state_of_another_search_is_refused(tmp_path, state):
    file = unfinished(tmp_path / "state.h5", state)
    before = file.read_bytes()
    others = [
        {"rng": 1}, {"strategy": "continuation"}, {"problem": chain(noise=0.01)}, {"max_evaluations": 500},
        {"start": np.array([2e4, 2e4, 5.0, 5.0])},
    ]  # fmt: skip
    for other in others:
        given = {"problem": chain(), "strategy": SHORT, "rng": 0, **other}
        with pytest.raises(sysid.InputError, match=r"state\.h5 is of another search"):
            sysid.identify(given.pop("problem"), checkpoint=file, **given)
    assert file.read_bytes() == before


def test_a_damaged_state_is_refused_and_left(tmp_path, state):
    file = unfinished(tmp_path / "state.h5", state)
    for image in (file.read_bytes()[:-1000], b"text", file.read_bytes()[:5000] + b"x" + file.read_bytes()[5001:]):
        file.write_bytes(image)
        with pytest.raises(sysid.InputError, match=r"state\.h5 cannot be read: it is damaged"):
            sysid.identify(chain(), strategy=SHORT, rng=0, checkpoint=file)
        assert file.read_bytes() == image


def test_a_result_is_no_state_and_a_state_no_result(tmp_path, state, uninterrupted):
    file = unfinished(tmp_path / "state.h5", state)
    with pytest.raises(sysid.InputError, match="unfinished search"):
        sysid.load(file)
    uninterrupted(SHORT).save(tmp_path / "result.h5")
    with pytest.raises(sysid.InputError, match="is not the state of an unfinished search"):
        sysid.identify(chain(), rng=0, checkpoint=tmp_path / "result.h5")


def test_a_state_that_cannot_be_written_any_more_ends_no_search(tmp_path, monkeypatch, uninterrupted):
    """As on a disk that is full after the start: the last state that was written stays."""
    import sysid.results.checkpoint as module
    import sysid.search.session as journal

    monkeypatch.setattr(journal, "_SHARE", np.inf)  # however slow the disk, it writes at each iteration
    original, writes = module.to_bytes, []

    def full(tree, number):
        if "entries" in tree:
            if len(writes) == 3:
                raise sysid.InputError("no space left")
            writes.append(original(tree, number))
        return original(tree, number)

    monkeypatch.setattr(module, "to_bytes", full)
    file = tmp_path / "state.h5"
    with pytest.warns(UserWarning, match="the search goes on, but its state is not kept: no space left"):
        result = sysid.identify(chain(), strategy=SHORT, rng=0, checkpoint=Checkpoint(file, every=0.0))
    assert bits(result) == bits(uninterrupted(SHORT))
    assert file.read_bytes() == writes[-1]
    assert from_bytes(writes[-1])[0]["entries"]["0"]["part"] == "swarm"


def test_a_state_that_cannot_be_written_at_all_is_told_before_the_search(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(sysid.InputError, match=r"state\.h5 cannot be"):
        sysid.identify(chain(), strategy=SHORT, rng=0, callback=Counted(1), checkpoint=tmp_path / "file/state.h5")


def test_a_search_without_a_seed_cannot_be_found_again(tmp_path):
    with pytest.raises(sysid.InputError, match="checkpoint needs rng="):
        sysid.identify(chain(), checkpoint=tmp_path / "state.h5")

"""Refinement jobs: the same results wherever they run, whatever dies, and never twice."""

import contextlib
import hashlib
import json
import os
import sqlite3
import subprocess
import sys
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.jobs import JobResult, processes, submit
from sysid.jobs.engine import each
from sysid.jobs.minima import as_good, distinct

MODULE = '''"""Two floors."""

import casadi as ca
import numpy as np

import sysid
from stretch import STRETCH


def problem(*, data=None, rng=0, second=2e5):
    M, C = np.diag([300.0, 200.0, 0.0]), STRETCH.T @ np.diag([300.0, 200.0]) @ STRETCH
    K = STRETCH.T @ np.diag([3e5, second]) @ STRETCH
    truth = sysid.Structure(M, K, damping_matrix=C[:2, :2], n_base=1)
    k = sysid.Variable("spring", 2, lower=1e4, upper=1e6, log=True)
    test = sysid.simulate(truth, np.linspace(0.5, 10, 60))
    return sysid.Problem(test, mass=M, stiffness=STRETCH.T @ ca.diag(k) @ STRETCH, damping=C, goal=1e-6)
'''
NEIGHBOUR = "import numpy as np\n\nSTRETCH = np.array([[1.0, 0, -1], [-1, 1, 0]])\n"
SPRINGS = [3e5, 2e5]
DIES = "__import__('os')._exit(7)"


@pytest.fixture
def recipe(tmp_path, monkeypatch):
    """A module with a neighbour, by a path that holds in this folder only."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floors.py").write_text(MODULE)
    (tmp_path / "stretch.py").write_text(NEIGHBOUR)
    return sysid.Recipe("floors.py", start=np.array([2.9e5, 2.1e5]))


def by_index(results):
    return sorted(results, key=lambda result: result.index)


def same(one, other):
    return all(
        (a.index, a.seed, a.success, a.message, a.residual) == (b.index, b.seed, b.success, b.message, b.residual)
        and a.x.tobytes() == b.x.tobytes()
        for a, b in zip(one, other, strict=True)
    )


def test_many_starts_find_the_springs_with_the_same_bits_here_and_in_processes(recipe):
    here = list(submit(recipe, starts=4))
    assert [result.index for result in here] == [0, 1, 2, 3]
    assert len({result.seed for result in here}) == 4
    for result in here:
        assert result.success and result.residual < 1e-8
        np.testing.assert_allclose(result.x, SPRINGS, rtol=1e-6)
    assert same(by_index(submit(recipe, starts=4, executor=processes(2))), here)


def test_several_recipes_are_numbered_one_after_the_other(recipe):
    other = replace(recipe, parameters={"second": 1.5e5}, start=None)
    found = list(submit([recipe, other], starts=2))
    np.testing.assert_allclose([result.x[1] for result in found], [2e5, 2e5, 1.5e5, 1.5e5], rtol=1e-6)
    assert [result.index for result in found] == [0, 1, 2, 3]


def test_a_recipe_that_comes_again_is_built_once_whatever_its_start(recipe, monkeypatch):
    built, original = [], sysid.catalogue.built
    monkeypatch.setattr(sysid.catalogue, "built", lambda one: built.append(one) or original(one))
    other = replace(recipe, parameters={"second": 1.5e5})
    submit([recipe, other, replace(recipe, start=None), recipe], starts=2)
    assert built == [replace(recipe, start=None), replace(other, start=None)]


def test_one_and_true_make_two_problems_in_one_worker(recipe, tmp_path):
    (tmp_path / "floors.py").write_text(MODULE.replace("5, second]", "5, 1.5e5 if second is True else 2e5]"))
    found = list(submit([replace(recipe, parameters={"second": value}) for value in (1, True)]))
    np.testing.assert_allclose([result.x[1] for result in found], [2e5, 1.5e5], rtol=1e-6)


def test_a_job_without_a_structure_to_start_from_says_so(recipe):
    result = next(submit(replace(recipe, start=[1.0, 2.0, 3.0])))
    assert not result.success and result.x.size == 0 and np.isnan(result.residual)
    with pytest.raises(sysid.InputError, match=r"\(3,\)") as refused:
        sysid.identify(sysid.catalogue.build(replace(recipe, start=None)), start=[1.0, 2.0, 3.0])
    assert result.message.endswith(str(refused.value))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (dict(recipe=3), "a int: a job is rebuilt where it runs, so save the problem as a module"),
        (dict(recipe=[]), "no recipe"),
        (dict(starts=0), "starts is 0; give 1 or above"),
        (dict(executor=4), "executor is a int"),
        (dict(recipe=sysid.Recipe("nowhere.py")), "nowhere.py cannot be read"),
    ],
)
def test_mistakes_are_told_before_any_job(recipe, given, told):
    with pytest.raises(sysid.InputError, match=told):
        submit(**{"recipe": recipe, **given})


def test_threads_are_refused(recipe):
    with ThreadPoolExecutor(1) as threads, pytest.raises(sysid.InputError, match="IPOPT bears none"):
        submit(recipe, executor=threads)
    with pytest.raises(sysid.InputError, match="IPOPT bears none"):
        list(submit(recipe, executor=lambda: ThreadPoolExecutor(1)))
    with pytest.raises(sysid.InputError, match="workers is 0; give 1 or above"):
        processes(0)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system binds no process to processors")
def test_there_are_as_many_workers_as_processors_that_this_process_may_use():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        with processes()() as pool:
            assert pool._max_workers == 1
    finally:
        os.sched_setaffinity(0, allowed)


def test_a_pool_whose_worker_dies_is_built_again_and_only_the_task_to_blame_is_lost():
    """`eval` stands for a job: it is a function that every worker finds."""
    tasks = ["1", DIES, "3", "4"]
    answers = list(each(eval, tasks, processes(1), lambda task, why: (task, why)))
    assert sorted(answer for answer in answers if isinstance(answer, int)) == [1, 3, 4]  # they come as they end
    ((task, why),) = [answer for answer in answers if isinstance(answer, tuple)]
    assert task == DIES and "its worker died" in why


def test_workers_of_one_maker_start_once_and_have_one_thread_and_those_given_up_end():
    lost = lambda task, why: why  # noqa: E731
    where = '[__import__("os").getpid(), len(__import__("os").listdir("/proc/self/task"))]'
    one = processes(1)
    if not Path("/proc/self/task").is_dir():
        where = '[__import__("os").getpid(), 1]'
    (first,), (second,) = ([*each(eval, [where], one, lost)] for _ in range(2))
    assert first == second and first[1] == 1
    given_up = each(eval, [where, where], one, lost)
    assert next(given_up) == first
    given_up.close()
    (third,) = each(eval, [where], one, lost)
    assert third[0] != first[0]


def test_what_a_worker_raises_is_the_answer_of_its_task_alone():
    answers = list(each(eval, ["1/0", "2"], processes(1), lambda task, why: (task, why)))
    assert sorted(map(str, answers)) == [str(("1/0", "its worker failed (ZeroDivisionError: division by zero)")), "2"]


def test_a_pool_of_the_callers_own_is_not_built_again():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        answers = list(each(eval, [DIES, "2"], pool, lambda task, why: why))
    assert len(answers) == 2 and all("BrokenProcessPool" in str(answer) for answer in answers)


class Cancelling(Executor):
    """One that cancels its first futures, as Dask's does where the link to the scheduler breaks."""

    made = 0

    def __init__(self):
        Cancelling.made += 1

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        if Cancelling.made == 1:
            future.cancel()
            future.set_running_or_notify_cancel()
        else:
            future.set_result(fn(*args))
        return future


def test_tasks_that_an_executor_cancels_are_submitted_again_to_a_new_one_and_else_lost(monkeypatch):
    monkeypatch.setattr(Cancelling, "made", 0)
    lost = list(each(eval, ["1", "2"], Cancelling(), lambda task, why: why))
    assert len(lost) == 2 and all("it was cancelled" in why for why in lost)
    monkeypatch.setattr(Cancelling, "made", 0)
    assert sorted(each(eval, ["1", "2"], Cancelling, lambda task, why: why)) == [1, 2]


def test_a_start_that_leads_to_an_error_of_any_kind_leaves_the_others(recipe, monkeypatch):
    from sysid.jobs import job

    original, seen = job.descend, []

    def descend(*arguments):
        seen.append(1)
        if len(seen) == 1:
            raise np.linalg.LinAlgError("Singular matrix")
        return original(*arguments)

    monkeypatch.setattr(job, "descend", descend)
    first, second = submit(recipe, starts=2)
    assert (first.success, first.x.size, first.message) == (False, 0, "LinAlgError: Singular matrix")
    assert second.success


def test_a_worker_in_another_folder_finds_module_and_data(recipe, tmp_path, monkeypatch):
    """A module of the package is found by its name there too; what it reads is the user's."""
    from sysid.jobs.submission import _rooted

    (tmp_path / "records").mkdir()
    for module in ("mini_shake_table", "some.dotted.module"):
        assert _rooted(sysid.Recipe(module, "records")) == sysid.Recipe(module, str(tmp_path / "records"))
    assert _rooted(recipe).module == str(tmp_path / "floors.py")


class TestLedger:
    """The file in which results are kept."""

    def test_what_stands_there_is_not_computed_again(self, recipe, tmp_path):
        first = list(submit(recipe, starts=2, out=tmp_path / "jobs"))
        with sqlite3.connect(tmp_path / "jobs" / "jobs.sqlite") as file:
            rows = file.execute("SELECT job, result FROM results").fetchall()
            for job, result in rows:
                told = json.dumps([True, "from the ledger", *json.loads(result)[2:]])
                digest = hashlib.sha256(told.encode()).hexdigest()
                file.execute("UPDATE results SET result = ?, sha256 = ? WHERE job = ?", (told, digest, job))
        file.close()
        again = by_index(submit(recipe, starts=3, out=tmp_path / "jobs"))
        assert [result.message == "from the ledger" for result in again] == [True, True, False]
        assert same([replace(r, message="") for r in again[:2]], [replace(r, message="") for r in first])

    def test_an_iterator_that_was_left_keeps_what_it_gave(self, recipe, tmp_path):
        results = submit(recipe, starts=3, out=tmp_path)
        next(results)
        results.close()
        with sqlite3.connect(tmp_path / "jobs.sqlite") as file:
            assert file.execute("SELECT COUNT(*) FROM results").fetchone() == (1,)
        file.close()

    def test_another_text_of_the_module_is_another_job(self, recipe, tmp_path):
        list(submit(recipe, out=tmp_path))
        (tmp_path / "floors.py").write_text(MODULE.replace("second=2e5", "second=1.9e5"))
        (result,) = submit(recipe, out=tmp_path)
        assert result.x[1] == pytest.approx(1.9e5, rel=1e-6)

    @pytest.fixture
    def ran(self, monkeypatch):
        """Jobs that were run since: each gives a result at once."""
        jobs = []
        result = JobResult(0, 0, True, "ran", np.array(SPRINGS), 1e-9)
        monkeypatch.setitem(submit.__globals__, "run", lambda job: jobs.append(job) or replace(result, index=job.index))
        return jobs

    def test_a_change_in_what_the_problem_is_made_from_makes_another_job(self, recipe, tmp_path, ran):
        """Also a change that leaves a file's size and time as they were."""
        (tmp_path / "parts" / "inner").mkdir(parents=True)
        inner = tmp_path / "parts" / "inner" / "stretches.py"
        inner.write_text(NEIGHBOUR)
        (tmp_path / "stretch.py").write_text("from parts.inner.stretches import STRETCH\n")
        (tmp_path / "record.csv").write_text("1, 2")
        (tmp_path / "records" / "first").mkdir(parents=True)
        (tmp_path / "records" / "first" / "run.csv").write_text("1, 2")

        def again(data):
            ran.clear()
            (result,) = submit(replace(recipe, data=data), out=tmp_path / "records" / "jobs")
            assert result.message == "ran"
            return len(ran)

        for data in (None, "record.csv", "records"):
            assert [again(data), again(data)] == [1, 0]
        before = inner.stat()
        inner.write_text(NEIGHBOUR.replace("1.0", "1.5"))
        os.utime(inner, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert [again(None), again(None)] == [1, 0]
        before = (tmp_path / "record.csv").stat()
        (tmp_path / "record.csv").write_text("1, 3")
        os.utime(tmp_path / "record.csv", ns=(before.st_atime_ns, before.st_mtime_ns))
        assert [again("record.csv"), again("record.csv")] == [1, 0]
        again("records")
        (tmp_path / "records" / "first" / "run.csv").write_text("1, 2, 3")
        assert [again("records"), again("records")] == [1, 0]

    def test_another_version_of_sysid_makes_other_jobs_and_opens_the_ledger(self, recipe, tmp_path, ran, monkeypatch):
        from sysid.jobs import submission

        list(submit(recipe, starts=2, out=tmp_path))
        with monkeypatch.context() as patch:
            patch.setattr(submission, "__version__", "0.0.9")
            list(submit(recipe, starts=2, out=tmp_path))
        assert len(ran) == 4
        assert len(list(submit(recipe, starts=2, out=tmp_path))) == 2
        assert len(ran) == 4

    @pytest.mark.parametrize("damage", ["sha256 = '0'", "result = replace(result, 'ran', 'run')", "result = x'00ff'"])
    def test_a_damaged_result_is_told_and_computed_again(self, recipe, tmp_path, ran, damage):
        list(submit(recipe, starts=2, out=tmp_path))
        with sqlite3.connect(tmp_path / "jobs.sqlite") as file:
            file.execute(f"UPDATE results SET {damage} WHERE rowid = 2")
        file.close()
        with pytest.warns(UserWarning, match=r"1 of 2 results in .* are damaged: computed again"):
            assert [result.message for result in submit(recipe, starts=2, out=tmp_path)] == ["ran", "ran"]
        assert len(ran) == 3
        assert len(list(submit(recipe, starts=2, out=tmp_path))) == 2 and len(ran) == 3

    def test_numbers_come_back_in_the_same_bits(self, recipe, tmp_path, monkeypatch):
        x = np.array([0.1, -0.0, 5e-324, 1 / 3, 1.7976931348623157e308])
        one = JobResult(0, 0, False, "\udcff \u2028 'quoted'", x, np.nan)
        monkeypatch.setitem(submit.__globals__, "run", lambda job: one)
        list(submit(recipe, out=tmp_path))
        (again,) = submit(recipe, out=tmp_path, executor=lambda: pytest.fail("computed again"))
        assert again.x.tobytes() == x.tobytes() and np.isnan(again.residual)
        assert (again.success, again.message) == (False, one.message)

    def test_no_file_stays_open_where_no_result_is_asked_for_or_it_is_no_ledger(self, recipe, tmp_path, monkeypatch):
        opened, connect = [], sqlite3.connect
        monkeypatch.setattr(sqlite3, "connect", lambda path: opened.append(connect(path)) or opened[-1])
        submit(recipe, out=tmp_path)
        (tmp_path / "jobs.sqlite").write_text("no ledger" * 200)
        with pytest.raises(sysid.InputError, match="not a database"):
            submit(recipe, out=tmp_path)
        assert len(opened) == 2
        for file in opened:
            with pytest.raises(sqlite3.ProgrammingError, match="closed"):
                file.execute("SELECT 1")

    def test_a_folder_that_cannot_be_one_is_told(self, recipe, tmp_path):
        (tmp_path / "taken").write_text("a file")
        with pytest.raises(sysid.InputError, match=r"taken.*cannot be used"):
            submit(recipe, out=tmp_path / "taken")
        (tmp_path / "jobs.sqlite").write_text("no ledger" * 200)
        with pytest.raises(sysid.InputError, match=r"jobs\.sqlite cannot be used: file is not a database"):
            submit(recipe, out=tmp_path)

    @pytest.mark.parametrize(
        "schema",
        [
            "CREATE VIEW results AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) "
            "SELECT i AS job, i AS result, i AS sha256 FROM n",
            "CREATE TABLE bookmarks (place TEXT)",
            "CREATE TABLE results (job TEXT PRIMARY KEY, result TEXT DEFAULT (load_extension('evil')), sha256 TEXT)",
        ],
    )
    def test_a_file_with_sql_of_its_own_or_of_somebody_elses_is_no_ledger(self, recipe, tmp_path, schema):
        """A view that never ends would be read for ever; a table of another program is not written to."""
        with contextlib.closing(sqlite3.connect(tmp_path / "jobs.sqlite")) as file, file:
            file.execute(schema)
        before = (tmp_path / "jobs.sqlite").read_bytes()
        with pytest.raises(sysid.InputError, match=r"jobs\.sqlite is no ledger of jobs of this sysid"):
            submit(recipe, out=tmp_path)
        assert (tmp_path / "jobs.sqlite").read_bytes() == before

    def test_a_trigger_beside_the_table_is_refused(self, recipe, tmp_path):
        list(submit(recipe, out=tmp_path))
        with contextlib.closing(sqlite3.connect(tmp_path / "jobs.sqlite")) as file, file:
            file.execute("CREATE TRIGGER t AFTER INSERT ON results BEGIN DELETE FROM results; END")
        with pytest.raises(sysid.InputError, match="is no ledger of jobs"):
            submit(recipe, out=tmp_path)

    @pytest.mark.parametrize(
        "row",
        ["[" * 10**5, '[true, "", [[1.0]], 0.1, null]', "[true, 3, [1.0], 0.1, null]", "[1]", '["", "", 1, 2, {}]'],
    )
    def test_a_row_that_is_no_result_is_computed_again(self, recipe, tmp_path, row):
        (first,) = submit(recipe, out=tmp_path)
        with contextlib.closing(sqlite3.connect(tmp_path / "jobs.sqlite")) as file, file:
            file.execute("UPDATE results SET result = ?, sha256 = ?", (row, hashlib.sha256(row.encode()).hexdigest()))
        with pytest.warns(UserWarning, match="1 of 1 results in .* are damaged: computed again"):
            (again,) = submit(recipe, out=tmp_path)
        assert again.x.tobytes() == first.x.tobytes()


def test_ends_at_one_point_are_one_minimum(recipe):
    problem = sysid.catalogue.build(replace(recipe, start=None))

    def end(index, springs, residual):
        return JobResult(index, 0, residual < 1e-6, "", np.array(springs), residual)

    near = [3e5 * (1 + 1e-5), 2e5]
    ends = [end(0, SPRINGS, 1e-9), end(1, [9e5, 2e4], 0.3), end(2, near, 2e-9), end(3, [], np.nan)]
    first, second = distinct(problem.prepared, ends)
    assert ([r.index for r in first.results], first.residual) == ([0, 2], 1e-9)
    assert ([r.index for r in second.results], second.residual) == ([1], 0.3)
    assert as_good([first, second]) == [first]
    alike = distinct(problem.prepared, [end(0, SPRINGS, 0.01), end(1, [2e5, 3e5], 0.010001)])
    assert len(as_good(alike)) == 2


def test_an_unknown_that_is_zero_but_for_round_off_makes_no_further_minimum(recipe):
    """The brace may be within 5e4 N/m of zero, and is zero; the spring has no size but its own."""
    brace, spring = sysid.Variable("brace", lower=-5e4, upper=5e4), sysid.Variable("spring", lower=1.0, upper=1e9)
    built = sysid.catalogue.build(replace(recipe, start=None))
    K = np.array([[1.0, -1.0], [-1.0, 1.0]]) * spring + np.array([[1.0, 0.0], [0.0, 0.0]]) * (brace + 3e5)
    problem = sysid.Problem(built.measurement, mass=np.diag([300.0, 200.0]), stiffness=K, damping=np.eye(2))

    def apart(one, other):
        ends = [JobResult(i, 0, True, "", np.array(x), 1e-9) for i, x in enumerate((one, other))]
        return len(distinct(problem.prepared, ends)) == 2

    assert not apart([-4.4e-9, 2e5], [4.1e-9, 2e5])
    assert apart([0.0, 2e5], [1.0, 2e5])
    assert apart([0.0, 10.0], [0.0, 10.1])


def test_shares_of_one_mass_by_any_scale_are_one_minimum():
    """Only the ratios of shares make the masses; the lowest start is named among those that differ by round-off."""
    K = 1e3 * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]])
    truth = sysid.Structure(np.diag([3.0, 2, 0]), K, [0.01, 0.01], n_base=1)
    test = sysid.simulate(truth, np.linspace(1, 10, 20))
    problem = sysid.Problem(test, mass=sysid.LumpedMass(5.0), stiffness=sysid.ChainStiffness(1e2, 1e4))
    # Two shares, two springs, two damping ratios.
    shares = ([0.6, 0.4], [0.3, 0.2], [0.3, 0.3])
    residuals = (3e-12, 1e-12, 2e-12)
    ends = [
        JobResult(i, 0, True, "", np.array([*share, 1e3, 1e3, 0.01, 0.01]), residual)
        for i, (share, residual) in enumerate(zip(shares, residuals, strict=True))
    ]
    first, second = distinct(problem.prepared, ends)
    assert ([end.index for end in first.results], first.best.index) == ([0, 1], 0)
    assert [end.index for end in second.results] == [2]


def test_the_picture_of_starts_that_agree_has_ticks_that_differ(recipe):
    ends = [JobResult(i, 0, True, "", np.array(SPRINGS), 0.01234 * (1 + 1e-9 * i)) for i in range(3)]
    problem = sysid.catalogue.build(replace(recipe, start=None))
    ax = sysid.plot.minima(distinct(problem.prepared, ends)).axes[0]
    low, high = ax.get_ylim()
    shown = [tick for tick in ax.get_yticks() if low <= tick <= high]
    assert len({ax.yaxis.get_major_formatter()(tick) for tick in shown}) == len(shown) > 0
    assert low < 0.01 and high > 0.02


def test_a_cluster_gives_the_same_bits(recipe):
    distributed = pytest.importorskip("distributed", reason="needs the extra 'dask'")
    from sysid.jobs import cluster

    here = list(submit(recipe, starts=3))
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50, local_directory=str(Path.cwd())
    ) as workers:
        found = by_index(submit(recipe, starts=3, executor=cluster(workers.scheduler_address)))
    assert same(found, here)


CHAIN = """
import casadi as ca
import numpy as np
import sysid

n = 5
stretch = np.eye(n, n + 1) - np.eye(n, n + 1, -1)
stretch[0, n] = -1.0
M, K, C = (stretch.T @ np.diag(size * (1 + 0.1 * np.arange(n))) @ stretch for size in (0.0, 1e6, 600.0))
M[:n, :n] = 1000.0 * np.eye(n)
truth = sysid.Structure(M, K, damping_matrix=C[:n, :n], n_base=1)
test = sysid.simulate(truth, np.geomspace(0.5, 12, 150), noise=0.01, rng=0)
k, c = (sysid.Variable(name, n, lower=at / 10, upper=10 * at, log=True) for name, at in (("k", 1e6), ("c", 600.0)))
K, C = (stretch.T @ ca.diag(part) @ stretch for part in (k, c))
problem = sysid.Problem(test, mass=M, stiffness=K, damping=C)
print(sysid.identify(problem, strategy=sysid.Continuation(1), rng=0).x.tobytes().hex())
"""


def test_the_bits_do_not_depend_on_the_threads_that_linear_algebra_may_have():
    """IPOPT's own is another library than NumPy's; what the environment allows is what it starts with."""
    found = [
        subprocess.run(
            [sys.executable, "-c", CHAIN], env={**os.environ, "OPENBLAS_NUM_THREADS": threads}, capture_output=True,
            check=True, timeout=120,
        ).stdout
        for threads in ("1", "2")
    ]  # fmt: skip
    assert len(found[0]) > 100
    assert found[0] == found[1]

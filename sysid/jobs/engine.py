"""Run tasks on an executor, whatever kind it is; rebuild it where its workers died."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.context import BaseContext
from multiprocessing.util import Finalize
from threading import Thread
from typing import Any, TypeVar, cast

from sysid.errors import InputError, needed, whole_number
from sysid.search.session import DeferredInterrupt

Task = TypeVar("Task")
Answer = TypeVar("Answer")

_STARTED_WITH = {
    "PYTHONSAFEPATH": "1",  # before they are told this process's path of modules, they import from where they stand
    "OPENBLAS_NUM_THREADS": "1",  # a process that forks others must have no threads, and IPOPT bears none
}
_IMPORTED = ("sysid.jobs.job", "scipy.linalg", "scipy.special", "scipy.sparse", "scipy.optimize")
_IN_VAIN = 2  # pools in a row that a task alone may break
_WHY = 'is there enough memory, and does the script submit below if __name__ == "__main__"?'


def processes(workers: int | None = None) -> Callable[[], Executor]:
    """A maker of process pools for `submit`, each worker with one thread.

    Workers are forked from a process that is started once, has no threads and has imported what a job needs; on
    Windows each is spawned and imports by itself. The environment is that in which the first of them was started. A
    maker that is given to `submit` again has the same workers, which hold the problems that they built.

    A worker imports the script that was started, which therefore submits below ``if __name__ == "__main__":``.

    Parameters
    ----------
    workers : int, optional
        As many as processors that this process may use, by default.

    Raises
    ------
    InputError
        Where it is not a positive whole number.
    """
    return _Maker(_processors() if workers is None else whole_number("workers", workers, at_least=1))


class _Maker:
    """Makes a pool of processes, anew only where the last one is over: workers hold the problems that they built."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: _Processes | None = None

    def __call__(self) -> Executor:
        if self._pool is None or self._pool.over:
            with _environment_of_workers():  # the first pool starts a process that looks after what all share
                self._pool = _Processes(self._count, _context())
        return self._pool


def _context() -> BaseContext:
    """Start method of workers: never a fork of this process, with locks of threads that do not exist in the child."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED))
    return context


class _Processes(ProcessPoolExecutor):
    """Processes that Ctrl-C ends without a word, while they still import too; `over` is a pool that was shut down."""

    over = False

    def __init__(self, count: int, context: BaseContext) -> None:
        super().__init__(count, context, initializer=_end_at_interrupt)

    def _start_executor_manager_thread(self) -> None:
        """Start the thread that ends the workers, now or where the pool is dropped, with the first task.

        At its end a process of multiprocessing ends its queues, with priority 10, and waits for its children: workers
        that this thread had not ended by then would wait for ever.
        """
        before = self._executor_manager_thread
        super()._start_executor_manager_thread()
        if before is None:
            thread = cast(Thread, self._executor_manager_thread)
            Finalize(thread, _wait_for, (weakref.ref(self), weakref.ref(thread)), exitpriority=20)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no further tasks."""
        self.over = True
        super().shutdown(wait, cancel_futures=cancel_futures)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand over a task; a process that is started for it has Ctrl-C blocked until `_end_at_interrupt`."""
        with _ctrl_c_held(), _environment_of_workers():
            return super().submit(fn, *args, **kwargs)

    def end(self) -> None:
        """Give up what is not done, and end the processes at once."""
        with _ctrl_c_held():
            workers = list(self._processes.values())
            self.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.terminate()


def _wait_for(pool: weakref.ref[_Processes], thread: weakref.ref[Thread]) -> None:
    """Shut a pool down that is still there at this process's end, and wait for its thread, if it was dropped too."""
    if (left := pool()) is not None:
        left.shutdown()
    if (ending := thread()) is not None:
        ending.join()


@contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Hold Ctrl-C back until the end, and have it blocked in processes that are started meanwhile.

    Blocking alone does not hold it back: a thread of a library may take the signal. Windows knows no blocking.
    """
    held = DeferredInterrupt(patience=None)
    try:
        with held:
            before = set() if sys.platform == "win32" else signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                yield
            finally:
                if sys.platform != "win32":
                    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    finally:
        held.check()


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Start processes with `_STARTED_WITH` meanwhile: no threads, no modules from the working folder."""
    before = {name: os.environ.get(name) for name in _STARTED_WITH}
    os.environ.update(_STARTED_WITH)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def cluster(address: str) -> Callable[[], Executor]:
    """A maker of executors on a Dask cluster for `submit`; it needs the extra "dask".

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    InputError
        Where Dask is not installed, no scheduler answers, or a worker has several threads.
    """
    needed("distributed", "dask", "a cluster")

    def make() -> Executor:
        from distributed import Client

        try:
            client = Client(address, timeout="10s", set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {address}: {error or type(error).__name__}") from None
        workers = client.scheduler_info(n_workers=-1)["workers"]
        if any(worker["nthreads"] > 1 for worker in workers.values()):
            client.close()
            raise InputError(f"workers at {address} have several threads: start them with --nthreads 1")
        return _OnCluster(client)

    return make


class _OnCluster(Executor):
    """Dask's executor, with a client of its own."""

    def __init__(self, client: Any) -> None:
        self._client, self._executor = client, client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand a task to the scheduler."""
        return cast(Future[Any], self._executor.submit(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; its workers go on without us."""
        self._executor.shutdown(wait=wait)
        self._client.close()


def checked(executor: object) -> Executor:
    """The executor itself; refused where it is none, or one of threads, which IPOPT does not bear."""
    if not isinstance(executor, Executor):
        raise InputError(f"executor is a {type(executor).__name__}: give an Executor, or a function that makes one")
    if isinstance(executor, ThreadPoolExecutor):
        raise InputError("executor is a pool of threads, and IPOPT bears none: give sysid.jobs.processes(4)")
    return executor


def _processors() -> int:
    """Number of processors for this process: a batch system or a container often grants fewer than the machine has."""
    if sys.version_info >= (3, 13):
        return os.process_cpu_count() or 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _end_at_interrupt() -> None:
    """Let Ctrl-C end a worker without a word, from now on: the submitting process tells the user."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the submitting process ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def each(
    function: Callable[[Task], Answer],
    tasks: Sequence[Task],
    executor: Executor | Callable[[], Executor] | None,
    lost: Callable[[Task, str], Answer],
) -> Iterator[Answer]:
    """Answers of a function at the top of a module to all tasks, as they come.

    Without an executor they run here, one after the other. Of a function that makes an executor a new one is made where
    the last one broke, and what was unfinished is submitted again; with an executor itself it is lost. `lost` makes the
    answer to a task whose worker died or raised, and why.
    """
    if executor is None:
        yield from map(function, tasks)
    elif isinstance(executor, Executor):
        yield from (_answer(task, future, lost) for task, future in _submitted(function, tasks, executor))
    else:
        yield from _rebuilding(function, list(tasks), executor, lost)


def _rebuilding(
    function: Callable[[Task], Answer],
    left: list[Task],
    make: Callable[[], Executor],
    lost: Callable[[Task, str], Answer],
) -> Iterator[Answer]:
    """Answers by as many executors as it takes.

    A dead worker takes all tasks of its pool with it. Where none of them had ended, the first goes alone: if its
    pool breaks too, again and again, the task is to blame.
    """
    in_vain = 0
    while left:
        tasks = left[:1] if in_vain else left
        left = left[len(tasks) :]
        executor, unfinished, whole = checked(make()), list[Task](), False
        ours = executor if isinstance(executor, _Processes) else None
        try:
            for task, future in _submitted(function, tasks, executor, cancel=ours is None):
                if isinstance(_error(future), BrokenExecutor):
                    unfinished.append(task)
                else:
                    yield _answer(task, future, lost)
            whole = not unfinished
        finally:
            if ours is None:
                executor.shutdown(wait=False)
            elif not whole:  # else its workers stay, with the problems that they built
                ours.end()
        in_vain = in_vain + 1 if len(unfinished) == len(tasks) else 0
        if in_vain > _IN_VAIN:
            yield lost(unfinished.pop(), f"its worker died, {_IN_VAIN} times in a row: {_WHY}")
            in_vain = 0
        left = unfinished + left


def _submitted(
    function: Callable[[Task], Answer], tasks: Sequence[Task], executor: Executor, cancel: bool = True
) -> Iterator[tuple[Task, Future[Answer]]]:
    """Tasks with their futures as these end.

    With `cancel` those that are left at the end are cancelled. A pool of processes that breaks does not bear that: its
    thread sets them to an error, which a cancelled one refuses. The pool's own shutdown cancels them in that thread.
    """
    futures: dict[Future[Answer], Task] = {}
    broken: list[tuple[Task, Future[Answer]]] = []
    for task in tasks:
        try:
            futures[executor.submit(function, task)] = task
        except BrokenExecutor as error:  # while tasks were still handed over
            future: Future[Answer] = Future()
            future.set_exception(error)
            broken.append((task, future))
    try:
        for future in as_completed(futures):
            yield futures[future], future
        yield from broken
    finally:
        for future in futures if cancel else ():
            future.cancel()


def _answer(task: Task, future: Future[Answer], lost: Callable[[Task, str], Answer]) -> Answer:
    error = _error(future)
    return future.result() if error is None else lost(task, f"its worker failed ({type(error).__name__}: {error})")


def _error(future: Future[Answer]) -> BaseException | None:
    """Exception that ended a task; Dask cancels its futures where the link to the scheduler breaks."""
    return BrokenExecutor("it was cancelled") if future.cancelled() else future.exception()

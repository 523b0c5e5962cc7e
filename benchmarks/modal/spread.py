"""Many independent runs on two processes; IPOPT bears no threads."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_limits

Task = TypeVar("Task")
Answer = TypeVar("Answer")

WORKERS = 2


def spread(function: Callable[[Task], Answer], tasks: Iterable[Task]) -> list[Answer]:
    """Answers of a function at the top of a module to each task, in the tasks' order.

    A benchmark that runs beside others has one processor: it does them itself, and starts nobody who would first import
    all that it has imported.
    """
    if multiprocessing.parent_process() is not None:
        with threadpool_limits(limits=1):
            return list(map(function, tasks))
    context = multiprocessing.get_context("spawn")  # a fork would copy the threads' locks
    with ProcessPoolExecutor(WORKERS, mp_context=context, initializer=_one_thread) as pool:
        return list(pool.map(function, tasks))


def _one_thread() -> None:
    threadpool_limits(limits=1)

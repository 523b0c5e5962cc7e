"""Pools of processes at the end of the process that made them."""

import subprocess
import sys

import pytest

LEFT = """
    pool.submit(abs, -1).result()
    Finalize(pool, lambda: print(pool.over, flush=True), exitpriority=15)  # just before queues end
"""
DROPPED = """
    pool.submit(time.sleep, 2)
    thread = pool._executor_manager_thread
    del make, pool
    Finalize(None, lambda: print(not thread.is_alive(), flush=True), exitpriority=15)
"""
SCRIPT = """
import multiprocessing
import time
from multiprocessing.util import Finalize


def leave():
    from sysid.jobs import processes  # here: the first process does not need it

    make = processes(1)
    pool = make()
    {leaves}

if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=leave)
    process.start()
    process.join(60)
    print(process.exitcode, flush=True)
    process.kill()
"""


@pytest.mark.parametrize("leaves", [LEFT, DROPPED])
def test_a_process_may_end_with_a_pool_left_open_or_dropped(tmp_path, leaves):
    """It is shut down before queues end: else its workers would wait for ever, now and then."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(leaves=leaves.strip()))
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=True)
    assert run.stdout.split() == ["True", "0"], run.stderr

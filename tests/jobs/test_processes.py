"""Pools of processes at the end of the process that made them."""

import subprocess
import sys

LEAVES_A_POOL = """
import multiprocessing
from multiprocessing.util import Finalize

from sysid.jobs import processes


def leave():
    make = processes(1)
    pool = make()
    pool.submit(abs, -1).result()
    Finalize(pool, lambda: print(pool.over, flush=True), exitpriority=15)  # just before queues end


if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=leave)
    process.start()
    process.join(60)
    print(process.exitcode, flush=True)
    process.kill()
"""


def test_a_process_may_end_with_a_pool_left_open(tmp_path):
    """It is shut down before queues end: else its workers would wait for ever, now and then."""
    script = tmp_path / "script.py"
    script.write_text(LEAVES_A_POOL)
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=True)
    assert run.stdout.split() == ["True", "0"], run.stderr

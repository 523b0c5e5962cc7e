"""Jobs on a cluster of two worker machines, the link of one of which drops for half a minute: whether anything is lost.

The machines are network namespaces with a bridge between them; where these may not be made, each worker reaches its
scheduler through a TCP relay on this machine that holds everything back meanwhile.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import sysid
from benchmarks.jobs.lost_workers import MODULE, bits
from benchmarks.line import Line, above
from sysid import jobs

JOBS, BEFORE, CUT = 60, 5.0, 30.0  # s until the link drops, and for how long
BRIDGE, NETWORK, PORT = "sysid-br", "10.77.77", 8799


def lines(reduced: bool) -> Iterator[Line]:
    """Results of all jobs, with the bits that they have here."""
    if reduced or importlib.util.find_spec("distributed") is None:
        yield Line("a link that drops", "left out: it needs the extra 'dask' and two minutes")
        return
    with tempfile.TemporaryDirectory() as folder:
        module = Path(folder) / "chain.py"
        module.write_text(MODULE)
        recipe = sysid.Recipe(str(module))
        expected = {one.index: bits(one) for one in jobs.submit(recipe, starts=JOBS, executor=jobs.processes(2))}
        with contextlib.ExitStack() as stack:
            network = stack.enter_context(_Namespaces() if _may_make_namespaces() else _Relays())
            _start_cluster(stack, network)
            cutter = threading.Thread(target=_cut, args=(network,))
            cutter.start()
            there = jobs.cluster(network.address)
            found = {one.index: bits(one) for one in jobs.submit(recipe, starts=JOBS, executor=there)}
            cutter.join()
    alike = sum(found.get(index) == job for index, job in expected.items())
    yield above(f"{JOBS} jobs on two machines ({network.kind}), one link cut for {CUT:g} s: the same bits", alike, JOBS)


def _cut(network: _Namespaces | _Relays) -> None:
    time.sleep(BEFORE)
    network.cut(True)
    time.sleep(CUT)
    network.cut(False)


def _start_cluster(stack: contextlib.ExitStack, network: _Namespaces | _Relays) -> None:
    """A scheduler here and a worker on each machine, started again where it ends, as `docs/cluster.md` has it."""
    environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "100", "OPENBLAS_NUM_THREADS": "1"}
    dask = [sys.executable, "-m", "dask"]
    commands = [[*dask, "scheduler", "--host", network.host, "--port", str(PORT), "--no-dashboard"]]
    for machine in range(2):
        worker = [*dask, "worker", network.scheduler(machine), "--nthreads", "1", "--no-dashboard"]
        commands.append([*network.on(machine), "sh", "-c", 'while true; do "$@"; sleep 1; done', "worker", *worker])
    for command in commands:
        process = subprocess.Popen(
            command, env=environment, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        stack.callback(_end, process)
    deadline = time.monotonic() + 60
    while True:
        with contextlib.suppress(Exception):
            from distributed import Client

            with Client(network.address, timeout="5s", set_as_default=False) as client:
                client.wait_for_workers(2, timeout=30)
            return
        if time.monotonic() > deadline:
            raise RuntimeError("the cluster did not start")


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def _may_make_namespaces() -> bool:
    try:
        _ip("netns", "add", "sysid-try")
        _ip("netns", "delete", "sysid-try")
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


class _Namespaces:
    """Two machines behind a bridge."""

    kind, host = "network namespaces", f"{NETWORK}.1"
    address = f"tcp://{host}:{PORT}"

    def __enter__(self) -> _Namespaces:
        _ip("link", "add", BRIDGE, "type", "bridge")
        _ip("address", "add", f"{self.host}/24", "dev", BRIDGE)
        _ip("link", "set", BRIDGE, "up")
        for i in range(2):
            name, inside = f"sysid-w{i}", f"sysid-i{i}"
            _ip("netns", "add", name)
            _ip("link", "add", name, "type", "veth", "peer", "name", inside)
            _ip("link", "set", inside, "netns", name)
            _ip("link", "set", name, "master", BRIDGE, "up")
            for words in (
                ("address", "add", f"{NETWORK}.{10 + i}/24", "dev", inside), ("link", "set", inside, "up"),
                ("link", "set", "lo", "up"),
            ):  # fmt: skip
                _ip("-n", name, *words)
        return self

    def __exit__(self, *_: object) -> None:
        for i in range(2):
            _ip("netns", "delete", f"sysid-w{i}")  # takes its link with it
        _ip("link", "delete", BRIDGE)

    def scheduler(self, machine: int) -> str:
        """The scheduler's address for a worker."""
        return self.address

    def on(self, machine: int) -> list[str]:
        """Words before a command that runs there."""
        return ["ip", "netns", "exec", f"sysid-w{machine}"]

    def cut(self, down: bool) -> None:
        """Drop the first machine's link, or bring it back."""
        _ip("link", "set", "sysid-w0", "down" if down else "up")


class _Relays:
    """Two ports of this machine that lead to the scheduler."""

    kind, host = "a TCP relay", "127.0.0.1"
    address = f"tcp://{host}:{PORT}"

    def __enter__(self) -> _Relays:
        self._held, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._forward)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def scheduler(self, machine: int) -> str:
        """The scheduler's address for a worker."""
        return f"tcp://{self.host}:{PORT + 1}" if machine == 0 else self.address

    def on(self, machine: int) -> list[str]:
        """Nothing comes before a command."""
        return []

    def cut(self, down: bool) -> None:
        """Hold back all that the first worker and the scheduler say to each other."""
        if down:
            self._held.set()
        else:
            self._held.clear()

    def _forward(self) -> None:
        with contextlib.ExitStack() as stack, selectors.DefaultSelector() as selector:
            listener = stack.enter_context(socket.create_server((self.host, PORT + 1)))
            selector.register(listener, selectors.EVENT_READ)
            while not self._stop.is_set():
                if self._held.is_set():
                    time.sleep(0.1)
                    continue
                for key, _ in selector.select(0.1):
                    if key.fileobj is listener:
                        worker = stack.enter_context(listener.accept()[0])
                        try:
                            scheduler = stack.enter_context(socket.create_connection((self.host, PORT)))
                        except OSError:  # it is not there yet
                            worker.close()
                            continue
                        selector.register(worker, selectors.EVENT_READ, scheduler)
                        selector.register(scheduler, selectors.EVENT_READ, worker)
                        continue
                    data = b""
                    with contextlib.suppress(OSError):
                        data = key.fileobj.recv(65536)
                        key.data.sendall(data)
                    if not data:
                        for end in (key.fileobj, key.data):
                            with contextlib.suppress(KeyError, ValueError):
                                selector.unregister(end)
                            end.close()

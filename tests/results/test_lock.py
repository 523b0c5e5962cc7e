"""A lock of one process at a time, which ends with its process and leaves nothing."""

import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from sysid import InputError
from sysid.results import storage
from sysid.results.storage import LOCK_NAME, alone

# Holds the lock in another process until it is killed, or its input ends.
HOLDER = """
import errno, sys
from pathlib import Path
from sysid.results import storage

def without(file):
    raise OSError(errno.ENOSYS, "no locks")

if sys.argv[2] == "named":
    storage._lock = without
with storage.alone(Path(sys.argv[1]), "the folder", "wait"):
    print("held", flush=True)
    sys.stdin.read()
"""


def without_locks(file):
    """Error of a file system that has no locks."""
    raise OSError(errno.ENOSYS, "no locks")


@pytest.fixture(params=["of the system", "named"])
def kind(request, monkeypatch):
    """Both kinds of lock: that of the operating system, and that of a file system without."""
    if request.param == "named":
        if sys.platform == "win32":
            pytest.skip("Windows has locks on all file systems")
        monkeypatch.setattr(storage, "_lock", without_locks)
    return request.param


@pytest.fixture
def place(tmp_path):
    return tmp_path / "some" / "folder" / LOCK_NAME


def hold(place: Path):
    return alone(place, "the folder", "wait")


def other(place: Path, kind: str) -> subprocess.Popen:
    """Another process that holds the lock."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(place), kind], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_one_is_refused_with_the_process_that_holds_it(place, kind):
    with hold(place):
        with pytest.raises(InputError, match=rf"the folder is in use by another run \(process {os.getpid()} on .*wait"):
            hold(place).__enter__()
        with pytest.raises(InputError):  # and refusing it takes nothing away
            hold(place).__enter__()


def test_nothing_is_left_of_it(place, kind, tmp_path):
    for _ in range(2):
        with hold(place):
            assert place.parent.is_dir()
        assert list(tmp_path.iterdir()) == []


def test_an_error_inside_releases_it_and_files_stay(place, kind):
    with pytest.raises(ZeroDivisionError), hold(place):
        (place.parent / "result").write_text("found")
        raise ZeroDivisionError
    assert [path.name for path in place.parent.iterdir()] == ["result"]
    with hold(place):
        pass


def test_one_of_a_killed_process_is_stale(place, kind):
    process = other(place, kind)
    with pytest.raises(InputError, match=rf"process {process.pid} on "):
        hold(place).__enter__()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    with hold(place):
        assert kind == "named" or str(os.getpid()) in place.read_text()
    assert list(place.parent.parent.iterdir()) == [place.parent]
    assert list(place.parent.iterdir()) == []


def test_it_ends_with_its_process(place, kind):
    process = other(place, kind)
    process.communicate("")
    assert process.returncode == 0
    with hold(place):
        pass


@pytest.mark.parametrize(
    ("record", "stale"),
    [
        pytest.param("{host} {pid} {begun}", False, id="this process"),
        pytest.param("{host} {pid} 1", True, id="an earlier process of this number"),
        pytest.param("elsewhere {pid} 1", False, id="one on another host"),
    ],
)
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the system tells no process's begin")
def test_a_named_owner_is_known_by_host_number_and_begin(place, monkeypatch, record, stale):
    monkeypatch.setattr(storage, "_lock", without_locks)
    host, pid, begun = storage._process_record().split()
    place.parent.mkdir(parents=True)
    named = place.with_name(f"{LOCK_NAME}.owner")
    named.write_text(record.format(host=host, pid=pid, begun=begun))
    if stale:
        with hold(place):
            assert named.read_text() == f"{host} {pid} {begun}"
    else:
        with pytest.raises(InputError, match="in use"):
            hold(place).__enter__()
        assert named.read_text() == record.format(host=host, pid=pid, begun=begun)


def test_of_many_at_once_never_two_hold_it(place, kind):
    """Taking the file away while others open it is where a lock on nothing would come from."""
    inside, most, refused, held = 0, 0, 0, 0
    count = threading.Lock()
    end = threading.Barrier(4)

    def work():
        nonlocal inside, most, refused, held
        end.wait()
        for _ in range(50):
            try:
                with hold(place):
                    with count:
                        inside, held = inside + 1, held + 1
                        most = max(most, inside)
                    with count:
                        inside -= 1
            except InputError as error:
                assert "in use" in str(error)
                with count:
                    refused += 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (most, held + refused) == (1, 200)
    assert held > 0


@pytest.mark.skipif(os.geteuid() == 0 if hasattr(os, "geteuid") else True, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match=f"the folder cannot be written: {os.strerror(errno.EACCES)}"):
        hold(tmp_path / LOCK_NAME).__enter__()

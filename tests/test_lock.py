"""One writer: who holds a folder is named, who is dead or silent holds nothing."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from patience import wait_until

from tilestream import lock
from tilestream.errors import LockedError, UsageError
from tilestream.files import Files
from tilestream.lock import LOCK, Holder, only_writer, writer_of

HOLDS = """
import sys, time
from tilestream.lock import only_writer
with only_writer(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


def held_elsewhere(url: str) -> "subprocess.Popen[bytes]":
    process = subprocess.Popen([sys.executable, "-c", HOLDS, url], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    return process


def forged(url: str, **changes: object) -> None:
    Files.at(url).under(LOCK).write(replace(Holder.me(), **changes).content())


def test_the_second_process_says_who_holds_it_and_a_dead_one_holds_nothing(tmp_path: Path) -> None:
    process = held_elsewhere(str(tmp_path))
    try:
        named = rf"process {process.pid} on {socket.gethostname()}"
        with pytest.raises(LockedError, match=named), only_writer(tmp_path):
            pass
        assert writer_of(tmp_path).process == process.pid
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert writer_of(tmp_path) is None
    with only_writer(tmp_path):
        assert writer_of(tmp_path).process == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_another_thread_is_another_writer(tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(LockedError), only_writer(tmp_path):
        pass
    held, most, counting = 0, 0, threading.Lock()

    def work() -> None:
        nonlocal held, most
        for _ in range(20):
            try:
                with only_writer(tmp_path):
                    with counting:
                        held += 1
                        most = max(most, held)
                    time.sleep(0.001)
                    with counting:
                        held -= 1
            except LockedError:
                time.sleep(0.001)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1


@pytest.mark.parametrize(
    ("changes", "free"),
    [
        ({"host": "elsewhere"}, False),  # nobody here can tell whether it lives
        ({"host": "elsewhere", "renewed": 0.0}, True),
        ({"renewed": 0.0}, True),  # its number is another process's now
        ({}, False),
    ],
)
def test_who_has_been_silent_for_a_minute_holds_nothing(
    tmp_path: Path, changes: dict[str, object], free: bool
) -> None:
    forged(str(tmp_path), **changes)
    assert (writer_of(tmp_path) is None) == free
    if free:
        with only_writer(tmp_path):
            pass
    else:
        with pytest.raises(LockedError, match="is being written by"), only_writer(tmp_path):
            pass


def test_a_lock_is_renewed_while_its_process_lives_and_never_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "RENEWED_EVERY", 0.02)
    with only_writer(tmp_path):
        first = writer_of(tmp_path)
        wait_until(lambda: writer_of(tmp_path).renewed > first.renewed, "the lock is renewed")
        forged(str(tmp_path), host="elsewhere")  # which took it over while this one slept
        time.sleep(0.1)
        assert writer_of(tmp_path).host == "elsewhere"
    assert writer_of(tmp_path).host == "elsewhere"


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"host": 3}', b"\xff"])
def test_what_is_no_lock_of_ours_holds_nothing(tmp_path: Path, content: bytes) -> None:
    (tmp_path / LOCK).write_bytes(content)
    assert writer_of(tmp_path) is None
    with only_writer(tmp_path):
        assert json.loads((tmp_path / LOCK).read_bytes())["process"] == os.getpid()


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in ("file", "file/below"):
        with (
            pytest.raises(UsageError, match="is a file, or below one"),
            only_writer(tmp_path / place),
        ):
            pass


def test_an_object_store_has_one_writer(s3_bucket: str) -> None:
    url = f"{s3_bucket}/map.zarr"
    with only_writer(url):
        assert writer_of(url).process == os.getpid()
        with pytest.raises(LockedError, match=f"process {os.getpid()}"), only_writer(url):
            pass
    assert writer_of(url) is None
    forged(url, host="elsewhere", renewed=0.0)
    with only_writer(url):
        assert writer_of(url).host == socket.gethostname()


def test_of_two_that_take_over_an_old_lock_one_gives_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an object store both may have removed the old one: the later lock holds."""
    url = f"memory://lock-{tmp_path.name}"
    forged(url, host="elsewhere", renewed=0.0)
    meanwhile = SimpleNamespace(time=time.time, sleep=lambda _: forged(url, host="another"))
    monkeypatch.setattr(lock, "time", meanwhile)
    with pytest.raises(LockedError, match="on another"), only_writer(url):
        pass
    assert writer_of(url).host == "another"


def test_a_lock_that_was_just_made_is_not_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process makes it between the look and the write."""
    url = f"memory://lock-{tmp_path.name}"
    look = Files.read_all

    def slow(folder: Files, names: list[str]) -> list[bytes | None]:
        found = look(folder, names)
        monkeypatch.setattr(Files, "read_all", look)
        forged(url, host="another")
        return found

    monkeypatch.setattr(Files, "read_all", slow)
    with pytest.raises(LockedError, match="on another"), only_writer(url):
        pass

"""One writer: a directory or store that a process writes to is its own until it ends.

The lock is a small file, `.lock`: who holds it, on which host, and when that was last renewed. It
is taken over where its process is dead, on this host, or where nobody has renewed it for a while.
"""

import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from tilestream.errors import LockedError, UsageError
from tilestream.files import Files
from tilestream.marks import parsed

LOCK = ".lock"
"""Name of the lock in the folder that it is of."""
RENEWED_EVERY = 15.0
"""How often a lock is renewed [s]."""
STALE_AFTER = 60.0
"""A lock that nobody has renewed for so long is free [s]."""
SETTLED_AFTER = 2.0
"""How long two that take over the same lock of an object store may be apart [s]."""


@dataclass(frozen=True)
class Holder:
    """Who writes."""

    host: str
    """Name of the machine."""
    process: int
    """Its process."""
    since: float
    """When it began [s since the epoch]."""
    renewed: float
    """When it last said that it lives [s since the epoch]."""
    token: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Tells it from any other, also of the same process."""

    @classmethod
    def me(cls) -> "Holder":
        """This process, now."""
        now = time.time()
        return cls(socket.gethostname(), os.getpid(), now, now)

    @classmethod
    def of(cls, content: bytes | None) -> "Holder | None":
        """From a lock's content; None: nobody, or nothing that we wrote."""
        try:
            known = parsed(content or b"")
            return cls(**{name: kind(known[name]) for name, kind in _FIELDS.items()})
        except (ValueError, KeyError, TypeError):
            return None

    def content(self) -> bytes:
        """As the lock holds it."""
        return json.dumps(asdict(self)).encode()

    @property
    def lives(self) -> bool:
        """Whether it may still write: its process is there, and has renewed its lock lately."""
        if self.host == socket.gethostname() and not _runs(self.process):
            return False
        return abs(time.time() - self.renewed) < STALE_AFTER

    def __str__(self) -> str:
        began = datetime.fromtimestamp(self.since, UTC).isoformat(" ", "seconds")
        return f"process {self.process} on {self.host}, since {began}"


_FIELDS = {"host": str, "process": int, "since": float, "renewed": float, "token": str}


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True


@contextmanager
def only_writer(url: str | os.PathLike[str]) -> Iterator[None]:
    """Be the only process that writes to a folder, made where it is missing, or to a store.

    Args:
        url: a local path or any fsspec URL.

    Raises:
        LockedError: another process writes there; says which.
        UsageError: a file lies there, or where a folder above it would be.
    """
    folder = Files.at(url)
    made = not folder.there()
    try:
        folder.make()
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"{url} is a file, or below one: name another folder") from None
    me = Holder.me()
    other = _take(folder.under(LOCK), me)
    if other is not None:
        raise LockedError(
            f"{url} is being written by {other}: wait until it ends, or name another path"
        )
    ended = threading.Event()
    renewing = threading.Thread(
        target=_renew, args=(folder.under(LOCK), me, ended), name="lock", daemon=True
    )
    renewing.start()
    try:
        yield
    finally:
        ended.set()
        renewing.join()
        with suppress(OSError):  # a folder that was removed meanwhile, a disk that is gone
            _free(folder.under(LOCK), me)
            if made:
                folder.remove_empty()  # of a job that was refused before it wrote anything


def writer_of(url: str | os.PathLike[str]) -> Holder | None:
    """Who writes to a folder or store now; None: nobody."""
    try:
        holder = Holder.of(Files.at(url).under(LOCK).read())
    except (FileNotFoundError, NotADirectoryError):
        return None
    return holder if holder is not None and holder.lives else None


def _take(lock: Files, me: Holder) -> Holder | None:
    """Take a lock that is free; else who holds it."""
    if lock.local:
        with _alone(lock):
            there = Holder.of(lock.read())
            if there is not None and there.lives:
                return there
            lock.write(me.content())
        return None
    return _take_object(lock, me)


def _take_object(lock: Files, me: Holder) -> Holder | None:
    """As `_take`, in an object store: of two that come at once, one makes the lock, where the store
    knows conditional writes.
    """
    (content,) = lock.parent.read_all([LOCK])
    there = Holder.of(content)
    if there is not None and there.lives:
        return there
    if content is not None:
        lock.remove()
    try:
        lock.fs.pipe_file(lock.root, me.content(), mode="create")
    except FileExistsError:
        return _take_object(lock, me)
    if content is not None:  # another may have found the same old lock, and removed this new one
        time.sleep(SETTLED_AFTER)
        there = Holder.of(lock.parent.read_all([LOCK])[0])
        return (
            None
            if there is not None and there.token == me.token
            else there or _take_object(lock, me)
        )
    return None


def _renew(lock: Files, me: Holder, ended: threading.Event) -> None:
    """Say every now and then that this process lives, until it has ended or lost the lock."""
    while not ended.wait(RENEWED_EVERY):
        with suppress(OSError), _alone(lock):  # what fails now may be back the next time
            if _holds(lock, me):
                lock.write(replace(me, renewed=time.time()).content())


def _free(lock: Files, me: Holder) -> None:
    """Give the lock back, if it is still this one's."""
    if not lock.there():
        return
    with _alone(lock):
        if _holds(lock, me):
            lock.remove()


def _holds(lock: Files, me: Holder) -> bool:
    there = Holder.of(lock.read())
    return there is not None and there.token == me.token


@contextmanager
def _alone(lock: Files) -> Iterator[None]:
    """A lock, made where it is missing, that no other process here looks at meanwhile.

    Of an object store the lock itself has to do: it is made by one process only.
    """
    while lock.local:
        handle = os.open(lock.root, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            if not _is(handle, lock.root):
                continue  # it was freed, or renewed, in between
            yield
            return
        finally:
            os.close(handle)
    yield


def _is(handle: int, path: str) -> bool:
    """Whether an open file is the one that is there now."""
    try:
        return os.fstat(handle).st_ino == Path(path).stat().st_ino
    except FileNotFoundError:
        return False

"""Where compiled kernels are kept: in a folder that nobody else can write, or nowhere.

Compiling takes a minute, so Numba keeps the result on disk, as pickles: whoever can write the
folder runs code as its reader. Numba does not look who can, and refuses to start where it finds no
folder. So a place is chosen once for a process, before its first kernel is decorated. Of several
processes one compiles a kernel; the others wait for it and read what it made.
"""

import logging
import multiprocessing
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numba
from numba.core import event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

if sys.platform != "win32":
    import fcntl
    import grp
    import pwd

logger = logging.getLogger(__name__)
F = TypeVar("F", bound=Callable[..., Any])


class Decorator(Protocol):
    """Makes a kernel of a function."""

    def __call__(self, function: F, /) -> "Dispatcher[F]":
        """The kernel."""


def _is_own(group: int) -> bool:
    """Whether a group is this user's alone: of the same name, as most Linux systems make one."""
    try:
        user, named = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return named.gr_name == user and set(named.gr_mem) <= {user}


def _others_write(folder: Path) -> bool:
    """Whether a user other than this one and root can put files into a folder.

    Never on Windows, where its mode does not tell, and where profile and temporary folder are of
    one user.
    """
    if sys.platform == "win32":
        return False
    status = folder.stat()
    by_group = status.st_mode & stat.S_IWGRP and not _is_own(status.st_gid)
    return bool(status.st_uid not in (0, os.getuid()) or status.st_mode & stat.S_IWOTH or by_group)


def _of_numba() -> Path | None:
    """The folder in which Numba would keep the kernels of this package; None: it finds none."""

    def kernel() -> None:
        """Of this folder, as all kernels are."""

    try:
        folder = Path(str(numba.njit(cache=True)(kernel).stats.cache_path))
    except RuntimeError:  # "no locator available"
        return None
    # a home that nobody knows stays `~`: a folder wherever the process was started
    return None if folder.parts[0] == "~" else folder.resolve()


def _temporary() -> Path | None:
    """A folder of this user alone below the one for temporary files; None where it is not safe."""
    user = "" if sys.platform == "win32" else f"-{os.getuid()}"
    try:
        folder = Path(tempfile.gettempdir(), f"tilestream-numba{user}")
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError:
        return None
    safe = not folder.is_symlink() and not _others_write(folder) and os.access(folder, os.W_OK)
    return folder if safe else None


def _settle() -> bool:
    """Point Numba to a safe folder, and say so where it is not Numba's own choice.

    Returns:
        Whether there is one. `NUMBA_CACHE_DIR` holds it for the processes that this one starts.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return False
    folder = _of_numba()
    if folder is None:
        reason = "Numba finds no folder for them"
    elif _others_write(folder) or _others_write(folder.parent):
        reason = f"others can write {folder}, and would run code here"
    else:
        return True
    other = _temporary()
    if other is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(other)
        numba.config.reload_config()  # type: ignore[no-untyped-call]
    if multiprocessing.current_process().name == "MainProcess":  # or every worker would say it
        logger.warning(
            "kernels are %s: %s; set NUMBA_CACHE_DIR to a folder that only you can write",
            "compiled by every process anew" if other is None else f"cached in {other}",
            reason,
        )
    return other is not None


_KEPT = _settle()
"""Whether compiled kernels are kept."""
_HELD: set[Path] = set()
"""The locks of kernels that this process compiles now."""


class _FirstCompiled(event.Listener):
    """Says so when the first kernel of this process is compiled; those on disk are only read."""

    told = False

    def on_start(self, event: Any) -> None:
        """A kernel is not on disk."""
        if not self.told and event.data["dispatcher"].py_func.__module__.startswith(_PACKAGE):
            self.told = True
            logger.info(COMPILING)

    def on_end(self, event: Any) -> None:
        """It is compiled."""


_PACKAGE = f"{__name__.partition('.')[0]}."
COMPILING = "compiling kernels, once per installation: a minute or more"
event.register("numba:compile", _FirstCompiled())  # type: ignore[no-untyped-call]


def are_kept() -> bool:
    """Whether kernels are kept on disk from earlier: else the processes of a job compile them."""
    folder = kept_in()
    return folder is not None and any(folder.glob("*.nbi"))


def kept_in() -> Path | None:
    """The folder of the compiled kernels; None: every process compiles them anew."""
    return _of_numba() if _KEPT else None


def njit(**options: Any) -> Decorator:
    """Numba's decorator for every kernel of this package; one process compiles it at a time, the
    next finds it on disk.
    """

    def decorate(function: F) -> "Dispatcher[F]":
        kernel: Dispatcher[F] = numba.njit(cache=_KEPT, **options)(function)
        if not isinstance(kernel, Dispatcher) or kernel.stats.cache_path is None:
            return kernel  # interpreted, or compiled by every process anew
        lock = Path(kernel.stats.cache_path) / f"{function.__name__}.lock"
        compile_here = kernel.compile

        def compile_once(signature: Any) -> Any:
            # Numba's own lock first: threads that take the two in another order would wait for ever
            with global_compiler_lock, _alone(lock):
                return compile_here(signature)

        setattr(kernel, "compile", compile_once)  # noqa: B010 - a method, to mypy
        return kernel

    return decorate


@contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """Be the only process in here; where a file cannot be locked, one of several."""
    if sys.platform == "win32" or lock in _HELD:  # a kernel that calls itself compiles inside
        yield
        return
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError:
        yield
        return
    try:
        with suppress(OSError):  # a file system that knows no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        _HELD.add(lock)
        yield
    finally:
        _HELD.discard(lock)
        os.close(file)

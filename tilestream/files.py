"""Files at a path or URL: whole or not there, on the disk before they have their name.

A path is taken as it is: nothing in it is a pattern, and what is removed is named, never searched.
A place has one spelling (`place_of`), which it gets where it enters.
"""

import errno
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

import fsspec
from fsspec.implementations.local import LocalFileSystem

from tilestream.errors import TilestreamError, UsageError

PART = re.compile(r"^\..*\.[0-9a-f]{32}\.part$")
"""The name of a file while it is being written."""
URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)(?:::[A-Za-z0-9+.:-]+)?:(//?)")
"""How a URL begins, maybe one of fsspec's chains; a single letter is a drive of Windows."""
SECRET = re.compile(r"(?<=://)[^/@\s]*:[^/@\s]*@|\?.*$")
"""What of a URL may be nobody's business: user and password, a query with a signature."""
ON_DISK = ("file", "local")
"""The protocols of this machine's own files."""


def local_path(path: str | os.PathLike[str]) -> str:
    """The local path that a user names: `file://` and `~` are resolved, the rest stays as it is.

    Raises:
        UsageError: it is a URL of an object store, which is not read from there, or of no protocol.
    """
    named = _local(os.fspath(path))
    if named is None:
        raise UsageError(f"{path} is not on this machine, and is read from a disk: copy it here")
    return named


def place_of(url: str | os.PathLike[str]) -> str:
    """The one spelling of a place: of a local one its absolute path, else its URL.

    `~`, `file://`, `.` and `..` are resolved (a link before a `..` as the system does); other links
    stay.

    Args:
        url: a local path, relative to where this process works, or any fsspec URL.

    Raises:
        UsageError: a URL of a protocol that is not known or not installed, or one that has lost a
            slash, as `Path("s3://…")` does.
    """
    text = os.fspath(url)
    if not text:
        raise UsageError("a path is empty: name a file or a folder")
    path = _local(text)
    if path is None:
        return text.rstrip("/")
    head, up, tail = f"{path}{os.sep}".rpartition(f"{os.pardir}{os.sep}")
    return os.path.abspath(os.path.join(os.path.realpath(head + up), tail) if up else path)  # noqa: PTH100, PTH118


def without_secrets(place: str) -> str:
    """A place as it may be shown to anyone: of a URL without user, password and query.

    Examples:
        >>> without_secrets("sftp://me:word@host/map.zarr")
        'sftp://…host/map.zarr'
    """
    return SECRET.sub("…", place) if "://" in place else place


def _local(text: str) -> str | None:
    """The path of a local file; None: it is elsewhere.

    Raises:
        UsageError: as `place_of`.
    """
    begin = URL.match(text)
    protocol = begin[1] if begin else ""
    if begin is not None and protocol.lower() in ON_DISK:
        rest = text[begin.end() :]
        text = rest.removeprefix("localhost") if begin[2] == "//" else f"/{rest}"
    elif begin is not None and begin[2] == "//":
        _require(protocol, text)
        return None
    elif protocol and protocol in fsspec.available_protocols():
        raise UsageError(f"{text} is a URL that has lost a slash: give {protocol}://… as a text")
    return os.path.expanduser(text)  # noqa: PTH111 - of a glob too


def _require(protocol: str, text: str) -> None:
    """Refuse a URL that nothing here opens."""
    try:
        fsspec.get_filesystem_class(protocol)
    except ValueError:
        raise UsageError(f"{text}: {protocol}:// is no protocol that fsspec knows") from None
    except ImportError as error:
        raise UsageError(f"{text}: {error}") from None


@dataclass(frozen=True)
class Files:
    """Where files lie: a folder or a file on a disk or in an object store."""

    fs: Any
    """The fsspec filesystem."""
    root: str
    """Its path there; of a local one the absolute path."""

    @classmethod
    def at(cls, url: str | os.PathLike[str]) -> Self:
        """The place that a local path or an fsspec URL names.

        Raises:
            UsageError: as `place_of`.
        """
        text = place_of(url)
        if "://" not in text:
            return cls(LocalFileSystem(), text)
        fs, root = fsspec.core.url_to_fs(text)
        fs.use_listings_cache = False
        return cls(fs, str(root).rstrip("/"))

    @property
    def local(self) -> bool:
        """Whether it is on a disk of this machine."""
        return isinstance(self.fs, LocalFileSystem)

    @property
    def address(self) -> str:
        """Its path, or its URL: `at` gives this place again, also elsewhere."""
        return self.root if self.local else str(self.fs.unstrip_protocol(self.root))

    def __fspath__(self) -> str:
        return self.address

    @property
    def name(self) -> str:
        """The last part of it."""
        return self.root.rsplit("/", 1)[-1]

    def under(self, name: str) -> Self:
        """A place below: `name` may have several parts; empty: this place itself."""
        return type(self)(self.fs, f"{self.root}/{name}") if name else self

    @property
    def parent(self) -> Self:
        """The folder that it lies in."""
        return type(self)(self.fs, self.root.rsplit("/", 1)[0])

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """What a library of an object store raises becomes one error that names the place: no
        credentials, nobody who answers.
        """
        try:
            yield
        except (OSError, TilestreamError):
            raise
        except Exception as error:
            if self.local:
                raise
            said = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise OSError(errno.EIO, f"{self.address} cannot be reached ({said})") from error

    def read(self) -> bytes:
        """The bytes of this file.

        Raises:
            FileNotFoundError: it is not there.
            OSError: it cannot be read.
        """
        with self._reached():
            return bytes(self.fs.cat_file(self.root))

    def read_end(self, count: int) -> bytes:
        """The last bytes of this file, at most so many; raises as `read` does."""
        with self._reached():
            return bytes(self.fs.cat_file(self.root, start=-count))

    def read_all(self, names: Sequence[str]) -> list[bytes | None]:
        """The bytes of files below, in one request where that is possible; None: not there.

        Raises:
            OSError: one is there, or may be, and cannot be read: absent is not unreadable.
        """
        if not names:
            return []
        paths = [f"{self.root}/{name}" for name in names]
        with self._reached():
            found = self.fs.cat_ranges(paths, None, None, on_error="return")
            for content in found:
                if isinstance(content, Exception) and not isinstance(content, FileNotFoundError):
                    raise content
        return [None if isinstance(content, Exception) else bytes(content) for content in found]

    def write(self, content: bytes) -> None:
        """Write this file: whole and on the disk, or as it was."""
        if self.local:
            with self.writing() as file:
                file.write(content)
            return
        with self._reached():  # an object appears with its last byte
            self.fs.pipe_file(self.root, content)

    @contextmanager
    def writing(self) -> Iterator[BinaryIO]:
        """This file, to be written bit by bit: it has its name once it is whole and on the disk.

        In an object store, where an upload can be broken off half-way, it is read by nobody before
        something else vouches for it.
        """
        if not self.local:
            with self.fs.open(self.root, "wb") as file:
                yield file
            return
        target = Path(self.root)
        self.parent.make()
        part = target.with_name(f".{target.name}.{uuid.uuid4().hex}.part")
        try:
            with part.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        _sync(target.parent)

    def make(self) -> None:
        """Make this folder, with those above it.

        Raises:
            FileExistsError, NotADirectoryError: a file is in the way.
            UsageError: there is no such bucket: a typing error must not make one.
        """
        if not self.local:
            with self._reached():
                bucket = self.root.split("/")[0]  # empty where there are none
                if bucket and not self.fs.exists(bucket):
                    raise UsageError(
                        f"{self.address}: there is no {bucket}: create it first, or mend the "
                        "address"
                    )
                self.fs.makedirs(self.root, exist_ok=True)
            return
        folder = Path(self.root)
        missing = [way for way in (folder, *folder.parents) if not way.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for made in missing:
            _sync(made.parent)

    def there(self) -> bool:
        """Whether this file or folder is there."""
        with self._reached():
            return bool(self.fs.exists(self.root))

    def names(self) -> list[str]:
        """The names of what lies in this folder, sorted; none where it is not there."""
        try:
            with self._reached():
                entries = self.fs.ls(self.root, detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        paths = {str(entry).rstrip("/") for entry in entries} - {self.root}
        return sorted(path.rsplit("/", 1)[-1] for path in paths)

    def all_files(self) -> list[str]:
        """The files in this folder and below, seen from it, sorted; none where it is not there."""
        return sorted(str(path)[len(self.root) + 1 :] for path in self.fs.find(self.root))

    def remove(self) -> None:
        """Remove this file, or this folder with all in it, if it is there."""
        if self.local:
            way = Path(self.root)
            if way.is_dir() and not way.is_symlink():
                shutil.rmtree(way)
            else:
                way.unlink(missing_ok=True)
            return
        for path in [*self.fs.find(self.root), self.root]:
            try:
                self.fs.rm_file(path)
            except FileNotFoundError:
                continue

    def remove_empty(self) -> None:
        """Remove this folder if nothing is in it; in an object store there is none then."""
        if self.local and Path(self.root).is_dir() and not self.names():
            Path(self.root).rmdir()

    def remove_parts(self) -> None:
        """Remove the half-written files that killed writers have left in this folder."""
        for name in self.names():
            if PART.search(name):
                self.under(name).remove()


def _sync(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

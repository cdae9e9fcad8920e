"""What a power loss leaves of an ingest: its system calls recorded, every prefix rebuilt.

A file's data is on the disk once it was synced, a name once its folder was. Two disks are played,
the laziest that is allowed and an eager one: one keeps of names and data only what was synced, the
other all names, and of data only what was synced. After every call that changes what may be on
either, the map is built anew from what is there, and read: it must be the whole map, or say that it
is not.

    python benchmarks/power_loss.py
"""

import argparse


def options() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=4000, help="points of the map")
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import re
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import tilestream as ts
from tilestream.errors import TilestreamError
from tilestream.formats.points.pcd import write_pcd

CALLS = (
    "openat,open,creat,write,pwrite64,writev,ftruncate,fsync,fdatasync,rename,renameat,renameat2,"
    "mkdir,mkdirat,unlink,unlinkat,rmdir"
)
LINE = re.compile(r"^(?:\d+ +)?(\w+)\((.*)\) += (-?\d+)")
INGEST = "import sys, tilestream as ts; ts.ingest(sys.argv[2], sys.argv[1], tile_size=10.0)"
"""What is recorded; arguments are the store and the source."""
WRONG = "WHOLE, AND IS NOT"


@dataclass
class Node:
    """A file: what was written to it, and how much of that is on the disk."""

    data: bytearray = field(default_factory=bytearray)
    synced: bytes | None = None
    """None: nothing is; it is empty then."""


@dataclass
class Disk:
    """The files below a folder, as processes see them and as the disk has them."""

    root: str
    names: dict[str, Node | None] = field(default_factory=dict)
    """What is there by path; None: a folder."""
    durable: dict[str, Node | None] = field(default_factory=dict)
    """The names that are on the disk."""

    def sync_folder(self, folder: str) -> None:
        """The names in a folder are on the disk as they are."""
        inside = {n: node for n, node in self.names.items() if n.rsplit("/", 1)[0] == folder}
        for name in [n for n in self.durable if n.rsplit("/", 1)[0] == folder and n not in inside]:
            self._forget(self.durable, name)
        self.durable |= inside

    @staticmethod
    def _forget(names: dict[str, Node | None], name: str) -> None:
        for one in [n for n in names if n == name or n.startswith(f"{name}/")]:
            del names[one]

    def remove(self, name: str) -> None:
        """A name is gone, for processes."""
        self._forget(self.names, name)

    def move(self, old: str, new: str) -> None:
        """A file has another name, for processes."""
        self.names[new] = self.names.pop(old)

    def lazy(self) -> dict[str, bytes | None]:
        """What is left where nothing reached the disk by itself."""
        return {
            name: None if node is None else node.synced or b""
            for name, node in self.durable.items()
            if all(above in self.durable for above in _above(name, self.root))
        }

    def eager(self) -> dict[str, bytes | None]:
        """What is left where names reached the disk at once, and data when it was synced."""
        return {
            name: None if node is None else node.synced or b"" for name, node in self.names.items()
        }


def _above(name: str, root: str) -> Iterator[str]:
    folder = name.rsplit("/", 1)[0]
    while len(folder) > len(root):
        yield folder
        folder = folder.rsplit("/", 1)[0]


def recorded(url: Path, source: Path, log: Path) -> list[tuple[str, str, int]]:
    """The system calls of an ingest: name, arguments as text, result."""
    line = ["strace", "-f", "-qq", "-y", "-xx", "-s", "100000000", "-e", f"trace={CALLS}"]
    line += ["-o", str(log), sys.executable, "-c", INGEST, str(url), str(source)]
    subprocess.run(line, check=True)
    calls = []
    pending: dict[str, str] = {}
    for text in log.read_text().splitlines():
        process = text.split(" ", 1)[0]
        if text.endswith("<unfinished ...>"):
            pending[process] = text.removesuffix("<unfinished ...>").rstrip()
            continue
        resumed = re.search(r"<\.\.\. \w+ resumed>(.*)$", text)
        whole = pending.pop(process, "") + resumed[1] if resumed else text
        found = LINE.match(whole)
        if found and int(found[3]) >= 0:
            calls.append((found[1], found[2], int(found[3])))
    return calls


def _bytes(text: str) -> list[bytes]:
    """The strings among the arguments of a call, which strace writes in hex."""
    found = re.findall(r'"((?:\\x[0-9a-f]{2})*)"', text)
    return [bytes.fromhex(one.replace("\\x", "")) for one in found]


def _paths(text: str, root: str) -> list[str]:
    """The paths of a call below a folder: of open files, which stand in <>, then its strings."""
    opened = [bytes.fromhex(one.replace("\\x", "")) for one in re.findall(r"<((?:\\x..)*)>", text)]
    found = [one.decode("utf-8", "replace") for one in (*opened, *_bytes(text))]
    return [path for path in found if path == root or path.startswith(f"{root}/")]


def states(calls: list[tuple[str, str, int]], root: str) -> Iterator[Disk]:
    """The disk after every call that changes what may be left."""
    disk = Disk(root, {root: None}, {root: None})
    for name, text, result in calls:
        paths = _paths(text, root)
        if paths and _played(disk, name, text, paths, result):
            yield disk


def _played(disk: Disk, name: str, text: str, paths: list[str], result: int) -> bool:
    """Do a call; whether it changes what may be left."""
    path = paths[-1]
    node = disk.names.get(paths[0])
    match name:
        case "openat" | "open" | "creat":
            new = "O_CREAT" in text and path not in disk.names
            if not new and "O_TRUNC" not in text:
                return False
            disk.names[path] = Node()
        case "write" | "pwrite64" | "writev":
            if node is not None:
                node.data += b"".join(_bytes(text))[:result]
            return False
        case "fsync" | "fdatasync":
            if node is None:
                disk.sync_folder(paths[0])
            else:
                node.synced = bytes(node.data)
        case "rename" | "renameat" | "renameat2":
            disk.move(paths[-2], path)
        case "mkdir" | "mkdirat":
            disk.names[path] = None
        case _:
            disk.remove(path)
    return True


def outcome(files: dict[str, bytes | None], root: str, scratch: Path, whole: dict[str, int]) -> str:
    """How a map reads of which these files are left."""
    shutil.rmtree(scratch, ignore_errors=True)
    for name, data in sorted(files.items()):
        place = scratch / name[len(root) :].lstrip("/")
        if data is None:
            place.mkdir(parents=True, exist_ok=True)
        elif place.parent.is_dir():
            place.write_bytes(data)
    try:
        store = ts.open_store(str(scratch / "map.zarr"))
        condition = store.condition()
        if not condition.whole:
            return f"says that it is {str(condition).split(':')[0].split(',')[0]}"
        read = hashes(store)
    except TilestreamError as error:
        return f"{type(error).__name__}"
    return "whole, and is" if read == whole else WRONG


def hashes(store: ts.TileStore) -> dict[str, int]:
    """What the tiles of a map hold."""
    return {str(key): zlib.crc32(store.tile(key).points_mm().tobytes()) for key in store.keys()}


def main(points: int) -> None:
    """Record an ingest, rebuild what every prefix of it leaves, count how that reads."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary).resolve()
        root, source = folder / "disk", folder / "map.pcd"
        root.mkdir()
        write_pcd(source, np.random.default_rng(0).uniform(0.0, 30.0, (points, 3)))
        calls = recorded(root / "map.zarr", source, folder / "calls")
        whole = hashes(ts.open_store(str(root / "map.zarr")))
        found: Counter[tuple[str, str]] = Counter()
        seen: dict[tuple[str, int], str] = {}
        prefixes = 0
        for disk in states(calls, str(root)):
            prefixes += 1
            for kind, files in (("lazy", disk.lazy()), ("eager", disk.eager())):
                mark = kind, hash(tuple(sorted((n, d) for n, d in files.items() if d is not None)))
                if mark not in seen:
                    seen[mark] = outcome(files, str(root), folder / "left", whole)
                found[kind, seen[mark]] += 1
    made = Counter(name for name, _, _ in calls)
    print(
        f"{len(whole)} tiles; {made['fsync']} syncs, {made['rename']} renames, {made['write']} "
        f"writes; {prefixes} prefixes, {len(seen)} different disks"
    )
    for (kind, what), count in sorted(found.items()):
        print(f"{kind:6}{what:45}{count:6}")
    if any(what == WRONG for _, what in found):
        sys.exit("a map reads as whole and is not")


if __name__ == "__main__":
    main(GIVEN.points)

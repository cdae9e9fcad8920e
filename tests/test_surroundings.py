"""What surrounds a job changes no result: settings of libraries, the folder, the cluster."""

import asyncio
import hashlib
import os
import subprocess
import sys
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dask.config
import distributed
import numpy as np
import pytest
import zarr
from elsewhere import scheduler_elsewhere
from patience import PATIENCE

import tilestream as ts
from tilestream.errors import TaskError, UsageError
from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.pipeline.engine.cluster import dask_client, report_kept
from tilestream.pipeline.engine.seen import require_seen


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    points = np.random.default_rng(1).uniform(0.0, 40.0, (4000, 3)) * [1, 1, 0.1]
    write_pcd(tmp_path / "cloud.pcd", points)
    return tmp_path / "cloud.pcd"


def bytes_of(store: ts.TileStore) -> dict[str, str]:
    """The hash of every tile's file."""
    root = Path(store.url)
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.parent != root
    }


@pytest.mark.parametrize(
    "setting",
    [
        {"default_zarr_format": 2},
        {"array.order": "F"},
        {"array.write_empty_chunks": False},
        {"threading.max_workers": 1},
    ],
    ids=str,
)
def test_settings_of_zarr_change_no_byte(
    setting: dict[str, Any], cloud: Path, tmp_path: Path
) -> None:
    usual = ts.ingest(cloud, tmp_path / "usual.zarr", tile_size=20.0)
    with zarr.config.set(setting):
        other = ts.ingest(cloud, tmp_path / "other.zarr", tile_size=20.0)
        assert bytes_of(other) == bytes_of(usual)
        again = ts.open_store(usual.url)
        assert len(again.tile(again.keys()[0]).points()) > 100
    assert zarr.open_group(other.url, mode="r").metadata.zarr_format == 3


def test_the_environment_of_zarr_neither(cloud: Path, tmp_path: Path) -> None:
    code = "import sys, tilestream as ts; print(len(ts.ingest(*sys.argv[1:]).keys()))"
    told = subprocess.run(
        [sys.executable, "-c", code, str(cloud), str(tmp_path / "map.zarr")],
        check=True,
        capture_output=True,
        text=True,
        env=os.environ | {"ZARR_DEFAULT_ZARR_FORMAT": "2"},
    )
    assert told.stdout == "1\n"
    usual = ts.ingest(cloud, tmp_path / "usual.zarr")
    assert bytes_of(ts.open_store(tmp_path / "map.zarr")) == bytes_of(usual)


def test_workers_that_work_elsewhere_know_what_a_relative_path_means(
    workers: distributed.Client, cloud: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert tmp_path not in map(Path, workers.run(os.getcwd).values())
    store = ts.ingest("cloud.pcd", "map.zarr", client=workers)
    assert len(store.keys()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.pcd", "map.zarr"]


def test_a_store_that_the_workers_do_not_see_is_named_once(
    workers: distributed.Client, cloud: Path
) -> None:
    url = f"memory://{uuid.uuid4().hex}/map.zarr"
    with pytest.raises(UsageError, match=r"cannot read memory:///.*all workers see") as told:
        ts.ingest(cloud, url, client=workers)
    assert "\n" not in str(told.value)
    assert not [name for name in Files.at(url).names() if "seen" in name]


def test_workers_see_a_folder_of_this_machine(workers: distributed.Client, tmp_path: Path) -> None:
    require_seen(workers, [str(tmp_path), str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_nobody_can_write_to_may_be_seen(
    workers: distributed.Client, tmp_path: Path
) -> None:
    if not Path("/proc/self").exists():
        pytest.skip("needs Linux")
    require_seen(workers, ["/proc"])
    with pytest.raises(UsageError, match="cannot read /proc/nowhere "):
        require_seen(workers, ["/proc/nowhere"])


def test_a_worker_that_is_gone_or_has_no_tilestream(tmp_path: Path) -> None:
    def client(**answers: object) -> SimpleNamespace:
        return SimpleNamespace(run=lambda *_, **__: answers)

    require_seen(client(a=OSError("gone"), b=""), [str(tmp_path)])
    with pytest.raises(UsageError, match=r"worker a .*No module named 'tilestream'"):
        require_seen(client(a=ImportError("No module named 'tilestream'")), [str(tmp_path)])
    assert list(tmp_path.iterdir()) == []


def test_an_asynchronous_client_is_refused(cloud: Path, tmp_path: Path) -> None:
    async def used() -> None:
        async with distributed.Client(
            asynchronous=True, processes=False, n_workers=1, dashboard_address=None
        ) as client:
            with pytest.raises(UsageError, match="made without asynchronous=True"):
                ts.ingest(cloud, tmp_path / "map.zarr", client=client)
            with pytest.raises(UsageError, match="asynchronous"), report_kept(client, "x.html"):
                pass

    asyncio.run(used())
    assert not list(tmp_path.glob("*.html"))


def test_without_a_folder_for_temporary_files_no_worker_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DASK_TEMPORARY_DIRECTORY", str(tmp_path / "file"))
    code = (
        "import sys\nfrom tilestream.cli import run\n"
        "sys.exit(run(['ingest', sys.argv[1], '--store', sys.argv[2], '--workers', '2']))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "file"), str(tmp_path / "map.zarr")],
        check=False,
        capture_output=True,
        text=True,
    )
    assert told.returncode == 2
    (line,) = [line for line in told.stderr.splitlines() if line.startswith("error: ")]
    assert "no temporary file can be written" in line
    assert not (tmp_path / "map.zarr").exists()


def test_a_cluster_that_does_not_start_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(**_: object) -> None:
        raise RuntimeError("Cluster failed to start: no more processes")

    monkeypatch.setattr(distributed, "LocalCluster", failing)
    with (
        pytest.raises(TaskError, match="no workers can be started here: Cluster failed"),
        dask_client(None, 2, 10**9),
    ):
        pass


# --- Workers elsewhere that do not see what the client sees


@contextmanager
def workers_elsewhere(
    *prefixes: Sequence[str], environment: Mapping[str, str] | None = None
) -> Iterator[distributed.Client]:
    """A client of workers in processes of their own, each started by a command that may change
    what it sees.
    """
    with (
        dask.config.set({"distributed.comm.timeouts.connect": f"{PATIENCE:g}s"}),
        scheduler_elsewhere(
            len(prefixes), plain=True, prefixes=prefixes, of_workers=environment
        ) as (address, _),
        dask_client(address, None, 10**9) as client,
    ):
        client.wait_for_workers(len(prefixes), timeout=PATIENCE)
        yield client


def blind_to(folder: Path) -> list[str]:
    """The command of a process in front of whose folder another one is mounted."""
    mount = f'mount -t tmpfs none {folder} && exec "$@"'
    command = ["unshare", "--mount", "--map-root-user", "sh", "-c", mount, "sh"]
    tried = subprocess.run([*command, "true"], capture_output=True, check=False)
    if tried.returncode:
        pytest.skip("needs a mount namespace of its own")
    return command


def test_workers_without_credentials_are_named_with_what_they_lack(
    cloud: Path, s3_bucket: str
) -> None:
    store = ts.ingest(cloud, f"{s3_bucket}/map.zarr")
    lacking = {name: "" for name in os.environ if name.startswith("AWS_") and "KEY" in name}
    assert lacking
    nowhere = {"AWS_EC2_METADATA_DISABLED": "true", "HOME": "/nowhere"}
    with workers_elsewhere([], [], environment={**lacking, **nowhere}) as client:
        with pytest.raises(UsageError) as told:
            ts.ingest(cloud, store.url, client=client)
        named = list(client.scheduler_info()["workers"])
    text = str(told.value)
    assert all(worker in text for worker in named)
    assert f"cannot read {store.url} (" in text
    assert "credentials" in text.split("): ")[1]
    assert "\n" not in text
    assert not [name for name in Files.at(store.url).names() if "seen" in name]


def test_a_worker_that_does_not_see_a_folder_or_a_source_is_named(
    cloud: Path, tmp_path: Path
) -> None:
    (tmp_path / "shared").mkdir()
    (tmp_path / "mine").mkdir()
    cloud = cloud.rename(tmp_path / "mine" / "cloud.pcd")
    store = str(tmp_path / "shared" / "map.zarr")
    for hidden, lacks in (("shared", store), ("mine", str(cloud))):
        with workers_elsewhere([], blind_to(tmp_path / hidden)) as client:
            with pytest.raises(UsageError) as told:
                ts.ingest(cloud, store, client=client)
            pids = client.run(os.getpid)
        text = str(told.value)
        assert f"cannot read {lacks} (" in text
        assert sum(worker in text for worker in pids) == 1
        assert "mount it there under the same name" in text
    assert not (tmp_path / "shared" / "map.zarr" / "tiles").exists()

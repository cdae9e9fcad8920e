"""Kernels compiled before there is a job: once per installation, a minute of one core."""

from pathlib import Path
from tempfile import TemporaryDirectory

from tilestream.kernels.cache import kept_in
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.jobs.run import run
from tilestream.pipeline.jobs.run_settings import RunSettings

SMALLEST = {
    "simulate": {"size": "small", "preset": "demo", "paths": ["I"], "every": 40},
    "observe": {"range_max": 30.0, "starts": 8, "draws": 2, "worlds": 1},
    "label": {"starts": {"radius": 0.2, "step": 0.2}},
    "model": {"recipe": "physics"},
}
"""A job that enters every stage, of one sample point."""


def warm(watch: Watch | None = None) -> Path | None:
    """Compile the kernels that jobs need, for an image of a cluster's workers or before a first
    job; where they are compiled, it takes some seconds.

    A job of one sample point is run in a temporary folder, in this process. Others that start
    meanwhile wait for each kernel that is being compiled.

    Args:
        watch: is told of each task that ended.

    Returns:
        The folder that keeps the kernels (`NUMBA_CACHE_DIR`, or the installation's own); None: no
        folder is safe, and every process compiles them anew.

    Examples:
        >>> folder = ts.warm()  # doctest: +SKIP
    """
    with TemporaryDirectory(prefix="tilestream-warm-") as folder:
        run(RunSettings.model_validate({"out": folder, **SMALLEST}), watch=watch)
    return kept_in()

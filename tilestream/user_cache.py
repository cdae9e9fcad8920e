"""Where what can be found out again is kept for a user."""

import os
from pathlib import Path


def user_cache() -> Path:
    """The folder of tilestream in the user's cache: `$XDG_CACHE_HOME` (or `~/.cache`)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tilestream"

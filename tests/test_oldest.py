"""tests/oldest.txt, which CI installs, holds the lower bounds of pyproject.toml and no others."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

TESTS = Path(__file__).parent
PROJECT = tomllib.loads((TESTS.parent / "pyproject.toml").read_text())["project"]
EXTRAS = ("e57", "ros", "s3", "test")
READERS = ("mypy", "ruff", "pandas-stubs", "scipy-stubs", "types-PyYAML")
"""Tools that read the code and do not run it."""


def versions(requirements: list[Requirement], operator: str) -> dict[tuple[str, str], Version]:
    """Name and marker to the version behind an operator, of which each requirement has one."""
    found = {}
    for requirement in requirements:
        (version,) = [s.version for s in requirement.specifier if s.operator == operator]
        found[requirement.name.lower(), str(requirement.marker or "")] = Version(version)
    return found


def test_the_oldest_set_is_that_of_the_lower_bounds() -> None:
    extras = [text for extra in EXTRAS for text in PROJECT["optional-dependencies"][extra]]
    wanted = [Requirement(text) for text in [*PROJECT["dependencies"], *extras]]
    run = [r for r in wanted if r.name not in (PROJECT["name"], *READERS)]
    lines = (TESTS / "oldest.txt").read_text().splitlines()
    pinned = [Requirement(line) for line in lines if not line.startswith("#")]
    assert versions(pinned, "==") == versions(run, ">=")
    assert len(pinned) == len(run)

"""What a shell is told when TAB is pressed, and what that imports."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tilestream.cli.app import COMMANDS, command_of, function_of
from tilestream.cli.completion import completable

SCIENCE = {"numpy", "pandas", "scipy", "numba", "dask", "zarr", "sklearn", "bokeh"}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def tab(line: str, cache: Path) -> tuple[list[str], set[str]]:
    """What completes a line as bash asks for it, and the packages that were imported for it."""
    words = line.split(" ")
    environment = {
        **os.environ,
        "_TILESTREAM_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
        "XDG_CACHE_HOME": str(cache),
        "PYTHONPROFILEIMPORTTIME": "1",
    }
    program = [sys.executable, "-m", "tilestream"]
    told = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    modules = {line.split("|")[-1].strip() for line in told.stderr.splitlines()}
    return told.stdout.split(), {module.partition(".")[0] for module in modules}


def test_the_list_of_commands_needs_none_of_the_science(cache: Path) -> None:
    found, imported = tab("tilestream ", cache)
    assert found == list(COMMANDS)
    assert not imported & SCIENCE
    assert tab("tilestream lo", cache)[0] == ["localize"]
    assert tab("tilestream --log-level w", cache)[0] == ["warning"]
    assert "--install-completion" in tab("tilestream --in", cache)[0]


def test_options_and_values_of_a_command(cache: Path) -> None:
    assert tab("tilestream run --fa", cache)[0] == ["--fail-over"]
    for line, wanted in {
        "tilestream run --fa": ["--fail-over"],
        "tilestream run --over ": ["places", "segments"],
        "tilestream run job.yaml --over s": ["segments"],
        "tilestream run --qui": ["--quiet"],
        "tilestream run --log-level=e": ["error"],
    }.items():
        found, imported = tab(line, cache)
        assert found == wanted, line
        assert not imported & SCIENCE  # it was kept


def test_what_is_kept_is_what_the_command_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in COMMANDS:
        completable(name, function_of)
        kept = json.loads((tmp_path / "tilestream" / f"options-{name}.json").read_text())
        own = {parameter.name for parameter in command_of(name).params}
        found = {parameter["name"] for parameter in kept["parameters"]}
        assert found == own - {"debug", "quiet", "log_level"}, name


def test_a_kept_file_that_is_old_or_damaged_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "tilestream" / "options-plan.json"
    completable("plan", function_of)
    good = file.read_text()
    for bad in ("{", "[]", json.dumps({**json.loads(good), "state": "old", "parameters": []})):
        file.write_text(bad)
        completable("plan", function_of)
        assert file.read_text() == good


def test_a_shell_is_given_its_script(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "tilestream", "--show-completion", "bash"]
    environment = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    told = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    assert "_TILESTREAM_COMPLETE=complete_bash" in told.stdout

"""What completion needs of a command, kept from one TAB to the next: its import takes seconds."""

import inspect
import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from typer.models import ArgumentInfo, OptionInfo

from tilestream.user_cache import user_cache

PACKAGE = Path(__file__).parents[1]
POSITIONAL = inspect.Parameter.POSITIONAL_OR_KEYWORD


def completable(
    name: str, function_of: Callable[[str], Callable[..., None]]
) -> Callable[..., None]:
    """A function that has the arguments and options of a command, and does nothing.

    They are read from the user's cache; where they are not there, or the package has changed since,
    from the command, and kept.

    Args:
        name: of the command.
        function_of: imports the function of a command by its name.
    """
    file, state = user_cache() / f"options-{name}.json", _state_of_package()
    with suppress(OSError, ValueError, KeyError, TypeError):
        kept = json.loads(file.read_text())
        if kept["state"] == state:
            return _function(kept["parameters"])
    found = list(_plain(function_of(name)))
    with suppress(OSError):  # a home that cannot be written to is no reason to fail
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"state": state, "parameters": found}))
    return _function(found)


def _state_of_package() -> str:
    """Changes with any source file of the package."""
    stats = sorted((str(path), path.stat().st_mtime_ns) for path in PACKAGE.rglob("*.py"))
    return f"{zlib.crc32(repr(stats).encode()):08x}"


def _plain(function: Callable[..., None]) -> Iterator[dict[str, Any]]:
    """What completion needs of each argument and option."""
    for parameter in inspect.signature(function).parameters.values():
        for how in get_args(parameter.annotation):
            if isinstance(how, OptionInfo | ArgumentInfo):
                kinds = set(_parts(get_args(parameter.annotation)[0]))
                yield {
                    "name": parameter.name,
                    "flags": list(how.param_decls or ()),
                    "option": isinstance(how, OptionInfo),
                    "switch": bool in kinds,
                    "many": list in kinds,
                    "choices": sorted({kind for kind in kinds if isinstance(kind, str)}),
                    "help": how.help or "",
                }


def _parts(kind: Any) -> Iterator[Any]:
    """A type and what it is made of: members of unions, values of literals, items of lists."""
    yield get_origin(kind) or kind
    for part in get_args(kind):
        yield from _parts(part)


def _function(parameters: list[dict[str, Any]]) -> Callable[..., None]:
    def nothing(**_: Any) -> None:
        """Only completed."""

    made = [_parameter(**one) for one in parameters]
    nothing.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined]
    return nothing


def _parameter(
    *,
    name: str,
    flags: list[str],
    option: bool,
    switch: bool,
    many: bool,
    choices: list[str],
    help: str,  # noqa: A002 - as typer calls it
) -> inspect.Parameter:
    kind: Any = bool if switch else Literal[tuple(choices)] if choices else str
    kind = list[kind] if many else kind
    how: Any = typer.Option(*flags, help=help) if option else typer.Argument(help=help)
    default: Any = False if switch else [] if many else None
    return inspect.Parameter(
        name, POSITIONAL, default=default, annotation=Annotated[kind | None, how]
    )

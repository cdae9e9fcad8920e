"""Options of commands that are made from the fields of settings: name, type, default and help."""

import functools
import inspect
import re
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer
from pydantic.fields import FieldInfo

from tilestream.config import Settings
from tilestream.errors import SettingsError, UsageError
from tilestream.settings import LogSettings

OLD_FLAGS = {"range_max": "max-range", "blind_rear_deg": "blind-rear", "sweep_s": "sweep"}
"""Flags of version 0.1 that are still taken, by the setting that they are now called after."""

MAP, PLACES, STARTS = "The map", "Places and virtual drives", "Scans, starts and registrations"
LOGS, REPORT, GATE, TASKS = "How logs are read", "The report", "A gate", "Where tasks run"
PANELS = {
    **dict.fromkeys(("crs", "partial", "keep_noise"), MAP),
    **dict.fromkeys(("spacing", "cell_size", "route_z", "project_to", "prediction_error"), PLACES),
    **dict.fromkeys(("range_max", "blind_rear_deg"), PLACES),
    **dict.fromkeys(("true_pose", "scans_per_point", "allow_overlap", "scan_leaf"), STARTS),
    **dict.fromkeys(("radius", "step", "beams", "deskew", "sweep_s"), STARTS),
    **dict.fromkeys(LogSettings.model_fields, LOGS),
    **dict.fromkeys(("threshold", "title", "own_range"), REPORT),
    **dict.fromkeys(("fail_over", "fail_worse", "measure", "over"), GATE),
    "memory": TASKS,
}
"""Headings of options in the help, by setting; the usual ones have none, and come first."""
FEW = 7
"""A command of so many settings needs no headings."""
ORDER = (None, PLACES, MAP, STARTS, LOGS, REPORT, GATE, TASKS)


WORD = re.compile(r"\w+")
"""What may be the name of a setting in a text."""
CONTEXT, KEYWORD = "context", inspect.Parameter.POSITIONAL_OR_KEYWORD
"""The argument by which a command gets the line that it was called with."""


@dataclass(frozen=True)
class Fields:
    """Which fields of settings a command has as options."""

    names: tuple[str, ...]
    """The fields; the others keep their defaults."""
    own: dict[str, Any] = field(default_factory=dict)
    """Defaults that the command has of its own."""


def fields(*names: str, **own: Any) -> Fields:
    """Marks an argument of a command: these fields of its settings are options.

    Args:
        names: the fields.
        own: defaults of the command's own.
    """
    return Fields(names, own)


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command an option for each field of the settings that it takes.

    An argument `Annotated[SomeSettings, fields(…)]` becomes these options; the command gets the
    settings that those on the line make (`model_fields_set`).

    Raises:
        UsageError: when the command runs, values that the settings refuse; names the options.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, tuple[type[Settings], Fields]] = {}
    parameters: list[inspect.Parameter] = []
    asked_for = [
        part for hint in hints.values() for part in get_args(hint) if isinstance(part, Fields)
    ]
    many = sum(len(chosen.names) for chosen in asked_for) > FEW
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        chosen = [part for part in get_args(hint) if isinstance(part, Fields)]
        if chosen:
            model = get_args(hint)[0]
            groups[parameter.name] = model, chosen[0]
            parameters += [
                _option(model, name, chosen[0].own, PANELS.get(name) if many else None)
                for name in chosen[0].names
            ]
        else:
            parameters.append(parameter.replace(annotation=hint))

    asked = any(parameter.name == CONTEXT for parameter in parameters)
    if not asked:
        parameters.append(inspect.Parameter(CONTEXT, KEYWORD, annotation=typer.Context))

    @functools.wraps(command)
    def wrapped(**values: Any) -> None:
        context = values[CONTEXT] if asked else values.pop(CONTEXT)
        for group, (model, chosen) in groups.items():
            of_line = {name: values.pop(name) for name in chosen.names}
            own = [name for name in of_line if name in chosen.own or was_given(context, name)]
            with options_named({name: _shown(model, name) for name in chosen.names}):
                values[group] = model(**{name: of_line[name] for name in own})
        command(**values)

    first = [p for p in parameters if p.default is inspect.Parameter.empty]
    rest = [p for p in parameters if p.default is not inspect.Parameter.empty]
    of_settings = {name for _, chosen in groups.values() for name in chosen.names}
    rest.sort(  # a command's own come first, then settings by their headings
        key=lambda p: ORDER.index(PANELS.get(p.name)) if p.name in of_settings else -1
    )
    wrapped.__signature__ = inspect.Signature([*first, *rest])  # type: ignore[attr-defined]
    return wrapped


@contextmanager
def options_named(shown: Mapping[str, str]) -> Iterator[None]:
    """What settings refuse is told with the options as they are typed, by the fields that they are
    of.
    """
    try:
        yield
    except SettingsError as error:
        told = []
        for key, wrong in error.problems:
            if key:
                field_, *levels = key.split(".")
                told.append(".".join([shown.get(field_, field_), *levels]) + wrong)
            else:  # of several together, which are named in the text
                several = WORD.sub(lambda found: shown.get(found[0], found[0]), wrong)
                told.append(f"this line{several}")
        raise UsageError("; ".join(told)) from None


def _shown(model: type[Settings], name: str) -> str:
    """A field as it stands on a line: an option, or an argument as the help calls it."""
    return name.upper() if model.model_fields[name].is_required() else flag(name)


def flag(name: str) -> str:
    """The option of a setting, e.g. `--range-max` of `range_max`."""
    return f"--{name.replace('_', '-')}"


def was_given(context: typer.Context, name: str) -> bool:
    """Whether an option is on the line: else its default is nothing that the user has said."""
    source = context.get_parameter_source(name)
    return source is None or source.name != "DEFAULT"


def _option(
    model: type[Settings], name: str, own: dict[str, Any], panel: str | None
) -> inspect.Parameter:
    """The option of a field: `--its-name`, with its default and its docstring as help; what has no
    default is an argument.
    """
    known = model.model_fields[name]
    needed = known.is_required()
    old = OLD_FLAGS.get(name)
    flags = [flag(name), *([f"--{old}"] if old else [])]
    how: Any = (
        typer.Argument(help=help_of(known))
        if needed
        else typer.Option(*flags, help=help_of(known), rich_help_panel=panel)
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=inspect.Parameter.empty if needed else own.get(name, known.default),
        annotation=Annotated[_type_of(known), how],
    )


def help_of(known: FieldInfo) -> str:
    """The docstring of a field on one line."""
    return " ".join((known.description or "").split())


def _type_of(known: FieldInfo) -> Any:
    """What a field takes on a command line: a text where it takes settings or an amount."""
    if isinstance(known.default, str) and get_origin(known.annotation) is not Literal:
        texts = [part for part in _parts(known.annotation) if get_origin(part) is Literal]
        return texts[0] if texts else str
    kinds = [_plain(part) for part in _parts(known.annotation)]
    return kinds[0] if len(kinds) == 1 else Union[tuple(kinds)]  # noqa: UP007 - made at run time


def _parts(annotation: Any) -> tuple[Any, ...]:
    """The members of a union; of anything else itself."""
    united = get_origin(annotation) in (Union, types.UnionType)
    return get_args(annotation) if united else (annotation,)


def _plain(annotation: Any) -> Any:
    """A type without its limits, which the settings check."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation

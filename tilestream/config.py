"""What all settings are: frozen pydantic models; unknown keys refused.

The docstring of a field is its documentation: meaning, and the unit in brackets. `tilestream
explain` and the help of the command line print it.
"""

import difflib
import re
import reprlib
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from tilestream.errors import SettingsError

NESTED = re.compile(r" \w+Settings: ")
"""How settings inside others begin what is wrong with them: the key above says which they are."""


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error at every level.

    Raises:
        SettingsError: a value that cannot be; names each key and what is wrong with it.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            known = list(type(self).model_fields)
            raise SettingsError(type(self).__name__, tuple(_readable(error, known))) from None


def _readable(error: ValidationError, known: list[str]) -> Iterator[tuple[str, str]]:
    """Each key that is wrong, and how the sentence about it goes on."""
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            yield key, f" is no setting: {hint}"
        elif problem["type"] == "missing":
            yield key, " is missing: give it"
        elif problem["type"] == "value_error":
            said = problem["msg"].removeprefix("Value error, ")
            yield key, NESTED.sub(": ", f" {said}")
        else:
            yield key, f" is {reprlib.repr(problem['input'])}: {problem['msg']}"

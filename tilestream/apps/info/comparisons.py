"""What is in a folder of `compare`: its choices, and how far off each is."""

import json
from typing import Any

from tilestream.apps.info.kinds import COMPARISON
from tilestream.apps.info.record import Info, told
from tilestream.counts import count_of
from tilestream.errors import DamagedError, foreign_errors
from tilestream.files import Files
from tilestream.report.formatting import cm
from tilestream.settings import LogOptions


def described(path: str, _: LogOptions) -> Info:
    """A comparison: its choices, and the errors that are estimated of each."""
    file = Files.at(path).under(COMPARISON)
    advice = "run `tilestream compare` again"
    with foreign_errors(DamagedError, f"{file.address} is damaged", advice):
        content = json.loads(file.read())
        choices, facts = content["choices"], content["facts"]
        return Info(
            path=path,
            kind="comparison",
            format="comparison of vehicles and maps",
            points=content["places"],
            coverage={
                "places": content["places"],
                "routes": len(content["routes"]),
                "choices": len(choices),
            },
            contents=[
                *(_line(choice) for choice in choices),
                f"for the matcher {facts['matcher']}",
                f"made on the map {facts['map']}",
                "compare.html shows it",
            ],
            notes=told(content["notes"]),
        )


def _line(choice: dict[str, Any]) -> str:
    """A choice and its errors."""
    median, high = (" ".join(cm(choice[name]).split()) for name in ("median", "p95"))
    places = count_of(choice["estimated"], "place")
    return f"choice {choice['choice']}: median {median}, 95 % below {high}, {places} estimated"

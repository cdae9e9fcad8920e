"""The card of a model: what it was trained on, and over which lidars and matchers it holds."""

from collections.abc import Mapping
from typing import Any

from tilestream.matcher import RegistrationSettings
from tilestream.model.dataset import Dataset
from tilestream.model.making import inputs_of, judged_of, lidar_of, range_told, ranges_of

JUDGED = "judged"
"""Where a card says what of a making may differ from run to run; what is not named must be equal,
as of a model of one run all is."""
CHECKED = "checked"
"""Where a card says how its model was checked, and what it is worth."""


def card_of(dataset: Dataset) -> dict[str, Any]:
    """What a model of a dataset was trained on, as plain JSON: the same for the same data.

    Returns:
        `runs` (by name what is known of each: district, preset, seed), `districts`, `presets`,
        `seeds`, `places`, `drives`, `paths`, `blocks` (both counted once per district), `lidars`
        and `matchers` (in words), `inputs` (of each input the lowest and the highest value, or the
        words; `making.inputs_of`), `judged` (what may differ where it is used), `stages` (their
        versions, as far as known).
    """
    groups = sorted(set(dataset.rows["group"]))
    makings = [dataset.makings.get(group, dataset.made_with) for group in groups]
    runs = [dict(about) for about in dataset.runs.values()]
    return {
        "runs": {name: dict(about) for name, about in dataset.runs.items()},
        **{
            f"{name}s": sorted({str(about[name]) for about in runs if about.get(name) is not None})
            for name in ("district", "preset", "seed")
        },
        "places": len(dataset),
        "drives": groups,
        "paths": sorted(set(map(str, dataset.streets))),
        "blocks": len(set(dataset.pieces)),
        "lidars": sorted({lidar_of(making) for making in makings} - {""}),
        "matchers": sorted({_matcher(making) for making in makings} - {""}),
        "inputs": ranges_of([inputs_of(making) for making in makings]),
        JUDGED: judged_of(makings) if dataset.makings else [],
        "stages": dict(dataset.stages),
    }


def _matcher(making: Mapping[str, Any]) -> str:
    return RegistrationSettings(**making["matcher"]).told if "matcher" in making else ""


def card_told(card: Mapping[str, Any]) -> list[str]:
    """A card in words, a line for each of its entries that says something."""
    told = []
    for name, value in card.items():
        if name == "inputs":
            told += [f"trained over {key}: {range_told(known)}" for key, known in value.items()]
        elif isinstance(value, Mapping):
            told += [f"{name}: {key}: {_plain(one)}" for key, one in value.items()]
        elif value:
            told.append(f"{name}: {_plain(value)}")
    return told


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {one}" for name, one in value.items())
    return "; ".join(map(str, value)) if isinstance(value, list) else str(value)

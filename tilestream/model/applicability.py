"""Where a model may be used: for factors that were made as those of its training."""

from collections.abc import Mapping, Sequence
from typing import Any

from tilestream.errors import ModelError
from tilestream.factors.own import OWN
from tilestream.model.card import JUDGED
from tilestream.model.making import Outside, outside, shared
from tilestream.model.training import Model


def check_making(model: Model, made_with: Mapping[str, Any]) -> list[Outside]:
    """Refuse factors that were computed otherwise than those that a model was trained on.

    A model of several lidars judges what its card says may differ (lidar, its height, matcher,
    usable range, blind sector) by the range that it was trained over, and refuses the rest.

    Args:
        model: a trained or loaded model.
        made_with: what the factors were computed with: `dataset.made_with`, and what else the job
            knows (height of the lidar, thinning of the map, how the virtual drive sees).

    Returns:
        The inputs outside of what the model was trained over, whose estimates are out of domain.

    Raises:
        ModelError: names what differs, and says what to do.
    """
    judged = model.card.get(JUDGED, [])
    strange = outside(model.card["inputs"], made_with) if judged else []
    made_with = shared(made_with, judged)
    if "seeing" in model.made_with and "seeing" not in made_with:
        raise ModelError("the model needs the virtual drive: give observe in the config")
    if "seeing" in made_with and "seeing" not in model.made_with:
        raise ModelError(
            "the model was trained without the virtual drive: give observe: null in the config"
        )
    _check_own(model.made_with, made_with, model.factors)
    made_with = {name: value for name, value in made_with.items() if name != OWN}
    unsaid = sorted(set(made_with) - set(model.made_with))
    if unsaid:
        raise ModelError(
            f"the model does not say for which {' and '.join(unsaid)} it was trained, as those of "
            "older versions do not: train it again"
        )
    for name in sorted((set(model.made_with) | set(made_with)) - {OWN}):
        trained, given = model.made_with.get(name), made_with.get(name)
        if name == "units" and isinstance(trained, Mapping) and isinstance(given, Mapping):
            for factor in model.factors:
                if trained.get(factor) != given.get(factor):
                    raise ModelError(
                        f"{factor} is in {given.get(factor)!r} in the table and was in "
                        f"{trained.get(factor)!r} where the model was trained"
                    )
        elif trained != given and isinstance(trained, Mapping) and isinstance(given, Mapping):
            differ = sorted(k for k in {*trained, *given} if trained.get(k) != given.get(k))
            raise ModelError(
                f"{name} does not match in {', '.join(differ)}: the model was trained with "
                f"{_short(trained, differ)}, the table was made with {_short(given, differ)}: "
                "train a model for it"
            )
        elif trained != given:
            raise ModelError(
                f"{name} does not match: the model was trained with {trained!r}, the table was "
                f"made with {given!r}: train a model for it"
            )
    return strange


def _short(values: Mapping[str, Any], names: Sequence[str]) -> str:
    """The values of these names as text; of lists their length."""
    said = {k: values.get(k) for k in ("name", *names) if k in values}
    short = {k: f"{len(v)} values" if isinstance(v, list | tuple) else v for k, v in said.items()}
    return ", ".join(f"{name} {value}" for name, value in short.items())


def _check_own(
    trained: Mapping[str, Any], given: Mapping[str, Any], factors: Sequence[str]
) -> None:
    """Refuse a making without the factors of the user's own that a model learnt from, or with
    others of their names.

    Raises:
        ModelError: names the factor.
    """
    there = given.get(OWN, {})
    for name, source in trained.get(OWN, {}).items():
        if name in factors and there.get(name) != source:
            why = "is another one now" if name in there else "is not among those of the job"
            raise ModelError(
                f"the model learnt from the factor {name} of a file of its own, which {why}: name "
                "that file under factors, or train a model"
            )

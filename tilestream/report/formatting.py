"""Figures as a person reads them: for the templates, the charts, and the command line."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

CM_PER_M = 100.0
_GLUE = "\u00a0"
"""Between a figure and its unit, where a line must not break."""
NONE = "none"
"""Stands where there is no figure."""
DASH = "–"
MOST_TOLD = 8
"""Values of a list that are told."""


def known(value: Any) -> bool:
    """Whether there is a figure."""
    return value is not None and bool(np.isfinite(value))


def cm(metres: Any, digits: int = 1) -> str:
    """An error in centimetres."""
    return f"{metres * CM_PER_M:.{digits}f}{_GLUE}cm" if known(metres) else NONE


def cm_limit(metres: float) -> str:
    """A limit in centimetres, with all digits that were given."""
    return f"{metres * CM_PER_M:.10g}{_GLUE}cm"


def cm_about(metres: Any, digits: int | None) -> str:
    """An estimate in centimetres, with as many significant digits as it deserves; None: with a
    digit behind the point.
    """
    if digits is None or not known(metres):
        return cm(metres)
    return f"{_significant(metres * CM_PER_M, digits)}{_GLUE}cm"


def _significant(value: float, digits: int) -> str:
    """A number with so many significant digits, and zeros behind them: 123.4 with two is 120."""
    rounded = float(f"{value:.{digits - 1}e}")
    before = math.floor(math.log10(abs(rounded))) + 1 if rounded else 1
    return f"{rounded:.{max(digits - before, 0)}f}"


def cm_span(low: Any, high: Any, digits: int | None = None) -> str:
    """An interval in centimetres; digits as of `cm_about`."""
    if not (known(low) and known(high)):
        return NONE
    ends = (cm_about(end, digits).removesuffix(f"{_GLUE}cm") for end in (low, high))
    return f"{' to '.join(ends)}{_GLUE}cm"


def cm_by_name(lengths: Mapping[Any, Any], names: Sequence[str]) -> str:
    """Some lengths [m] in centimetres: `along 4.1, across 2.0, up 0.4 cm`; without those that are
    not known.
    """
    there = [f"{name} {lengths[name] * CM_PER_M:.1f}" for name in names if known(lengths[name])]
    return ", ".join(there) + f"{_GLUE}cm" if there else NONE


def percent(share: Any, digits: int = 1) -> str:
    """A share."""
    return f"{share * 100.0:.{digits}f}{_GLUE}%" if known(share) else NONE


def number(value: Any, digits: int = 2) -> str:
    """A figure without a unit."""
    return f"{value:.{digits}f}" if known(value) else DASH


def distance(metres: float) -> str:
    """A length of road."""
    return f"{metres / 1000.0:.2f}{_GLUE}km" if metres >= 1000.0 else f"{metres:.0f}{_GLUE}m"


def thousands(count: float) -> str:
    """A number of things, thousands apart."""
    return f"{count:,.0f}".replace(",", "\u202f")


def megabytes(size: Any) -> str:
    """A size in memory [bytes]."""
    return f"{size / 1e6:,.1f}{_GLUE}MB".replace(",", "\u202f") if known(size) else DASH


def fact(value: Any) -> str:
    """A setting, a version, a list of them; of a long list the first, and how many there are."""
    if isinstance(value, list):
        told = ", ".join(map(str, value[:MOST_TOLD])) or DASH
        more = len(value) - MOST_TOLD
        return f"{told} and {more} more (report.json)" if more > 0 else told
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return DASH if value is None else str(value)

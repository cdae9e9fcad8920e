"""Figures and tables as a person reads them; everything is escaped."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

CM_PER_M = 100.0
_GLUE = "\u00a0"
"""Between a figure and its unit, where a line must not break."""
NONE = "none"
"""Stands where there is no figure."""
DASH = "–"


def esc(value: object) -> str:
    """Text that is safe inside HTML, in an attribute too."""
    return html.escape(str(value), quote=True)


def known(value: Any) -> bool:
    """Whether there is a figure."""
    return value is not None and bool(np.isfinite(value))


def length(metres: Any, digits: int = 1) -> str:
    """An error in centimetres."""
    return f"{metres * CM_PER_M:.{digits}f}{_GLUE}cm" if known(metres) else NONE


def span(low: Any, high: Any) -> str:
    """An interval in centimetres."""
    if not (known(low) and known(high)):
        return NONE
    return f"{low * CM_PER_M:.1f} to {high * CM_PER_M:.1f}{_GLUE}cm"


def lengths(named: Mapping[str, Any]) -> str:
    """Errors by name in centimetres: `along 4.1, across 2.0, up 0.4 cm`; of none of them: none."""
    there = [f"{name} {m * CM_PER_M:.1f}" for name, m in named.items() if known(m)]
    return ", ".join(there) + f"{_GLUE}cm" if there else NONE


def percent(share: Any, digits: int = 1) -> str:
    """A share."""
    return f"{share * 100.0:.{digits}f}{_GLUE}%" if known(share) else NONE


def plain_number(value: Any, digits: int = 2) -> str:
    """A figure without a unit."""
    return f"{value:.{digits}f}" if known(value) else DASH


def road(metres: float) -> str:
    """A length of road."""
    return f"{metres / 1000.0:.2f}{_GLUE}km" if metres >= 1000.0 else f"{metres:.0f}{_GLUE}m"


def count(number: float) -> str:
    """A number of things, thousands apart."""
    return f"{number:,.0f}".replace(",", "\u202f")


def table(head: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "") -> str:
    """An HTML table of cells that are HTML already; the first column heads its row."""
    return _table(head, "<tbody>" + "".join(map(_row, rows)) + "</tbody>", kind)


def grouped_table(
    head: Sequence[str], groups: Sequence[tuple[str, Sequence[Sequence[str]]]], kind: str = ""
) -> str:
    """A table in parts, each under a heading of its own."""
    bodies = (
        f'<tbody><tr class="group"><th colspan="{len(head)}" scope="colgroup">{name}</th></tr>'
        + "".join(map(_row, rows))
        + "</tbody>"
        for name, rows in groups
    )
    return _table(head, "".join(bodies), kind)


def _table(head: Sequence[str], bodies: str, kind: str) -> str:
    named = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{named}</tr></thead>'
        f"{bodies}</table></div>"
    )


def _row(cells: Sequence[str]) -> str:
    first, *rest = cells
    return f'<tr><th scope="row">{first}</th>' + "".join(f"<td>{c}</td>" for c in rest) + "</tr>"


def bar(share: float, colour: str) -> str:
    """A horizontal bar, 0 to 1 of its cell."""
    width = 100.0 * min(max(share, 0.0), 1.0)
    return f'<span class="bar"><i style="width:{width:.1f}%;background:{colour}"></i></span>'


def section(name: str, title: str, meaning: str, body: str) -> str:
    """A section of the page: a heading, what it means in a sentence, and its content."""
    return (
        f'<section id="{name}"><h2>{title}</h2><p class="meaning">{meaning}</p>{body}</section>\n'
    )


def empty(why: str) -> str:
    """What stands where there is nothing to show."""
    return f'<p class="empty">{why}</p>'

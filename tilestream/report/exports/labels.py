"""What maps write beside the worst places."""

from tilestream.report.data import Findings, interpolated
from tilestream.report.formatting import cm, cm_about
from tilestream.report.measured import measure_of
from tilestream.report.segments import worst_places


def worst_labels(found: Findings) -> dict[int, str]:
    """Number and error of each of the worst places by its row, the worst first: `1: 78 cm`; an
    estimate with as many digits as it deserves, an error that was measured or interpolated says so.
    """
    error, between = measure_of(found.places), interpolated(found.places)
    told = {}
    for number, row in enumerate(worst_places(found.places), start=1):
        estimate, known = error.estimate[row], error.known[row]
        said = cm_about(known, found.digits) if known == estimate else f"{cm(known)} measured"
        said += " interpolated" if known == estimate and between[row] else ""
        told[row] = f"{number}: {said}".replace("\u00a0", " ")  # not every viewer's font has it
    return told

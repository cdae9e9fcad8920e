"""What the estimates of a run are worth: where the model was checked, on how much, how far off."""

from dataclasses import asdict, dataclass
from typing import Any

from tilestream.counts import count_of
from tilestream.model.intervals import LEVEL
from tilestream.report.formatting import cm_about, known, percent

HERE = "this map, by drives of this run"
BLOCKS = "this map, by held-out blocks of its drives"
OWN = "other maps of this maker"
ELSEWHERE = "real drives elsewhere"
SIMULATION = "simulation only"
NOWHERE = "nowhere"
"""Where estimates may have been checked, what proves most first."""
HELD_OUT = "on what was held out of its training"
"""Where the error of a model was found that was checked otherwise elsewhere."""
FEW = 10
"""Places below which a check tells nothing: a rank correlation of three is 1 or -1 by luck."""


@dataclass(frozen=True)
class Worth:
    """What the estimates of a run are worth. None is what is not known."""

    model: str
    """What makes them, in words."""
    checked: str
    """Where that was checked: `HERE` and so on."""
    places: int | None = None
    """On how many measured places."""
    drives: int | None = None
    """Of how many drives."""
    mae: float | None = None
    """Expected error of an estimate: its mean absolute error [m], in proportion to the estimates
    where it was found on another street …"""
    mae_of: str = ""
    """… and where that was found; most often where it was checked."""
    spearman: float | None = None
    """Rank correlation of estimate and measured error there."""
    spearman_low: float | None = None
    """Lower end of its interval."""
    spearman_high: float | None = None
    """Upper end."""
    coverage: float | None = None
    """Share of the measured errors there that lay in the interval of their estimate."""
    level_low: float | None = None
    """Ratio of the levels of estimated and measured errors, of the lidar with the lowest."""
    level_high: float | None = None
    """Of the lidar with the highest."""
    median: float | None = None
    """Median estimate of the run [m] …"""
    low: float | None = None
    """… and the ends of the interval of the place that has it [m]."""
    high: float | None = None
    """See `low`."""
    outside: float | None = None
    """Share of the estimated places that are unlike the training places."""
    trained_places: int | None = None
    """On how many places the model was trained; None: nothing was, or it is not known."""
    trained_drives: int | None = None
    """On how many drives."""
    trained_streets: int | None = None
    """Along how many streets."""
    trained_runs: int | None = None
    """Over how many runs."""
    lidars: int | None = None
    """Over how many lidars."""
    simulated: bool = False
    """Whether all that it was trained on was simulated, as far as its card says."""
    warnings: tuple[str, ...] = ()
    """Why to trust it less."""

    @property
    def share(self) -> float | None:
        """The expected error as a share of the median estimate."""
        if self.mae is None or not self.median:
            return None
        return self.mae / self.median

    @property
    def digits(self) -> int:
        """Significant digits that an estimate deserves: two, where its error is not known or some
        tens of percent; three below 5 %, one above 100 %.
        """
        if self.share is None:
            return 2
        return 3 if self.share < 0.05 else 2 if self.share < 1.0 else 1

    @property
    def told(self) -> tuple[str, ...]:
        """The same as sentences, the most important first."""
        sentences = (self._of(), self._check(), self._error(), self._interval(), self._outside())
        return tuple(" ".join(s.split()) for s in (*self.warnings, *sentences) if s)

    def plain(self) -> dict[str, Any]:
        """The fields, `digits`, and `told`."""
        return {**asdict(self), "digits": self.digits, "told": list(self.told)}

    def _of(self) -> str:
        counts = [
            _count(self.trained_places, "place"),
            _count(self.trained_drives, "drive"),
            _count(self.trained_runs, "run"),
            _count(self.lidars, "lidar"),
        ]
        there = ", ".join(count for count in counts if count)
        data = f", trained on {there}" if there else ""
        made = ", all of it simulated" if there and self.simulated else ""
        return f"The estimates are of {self.model}{data}{made}."

    def _check(self) -> str:
        if self.checked == NOWHERE:
            return "Checked nowhere: no measured error is known to have been compared with it."
        there = ", ".join(
            count for count in (_count(self.places, "place"), _count(self.drives, "drive")) if count
        )
        said = f"Checked on {self.checked}"
        said += f": {there}" if there else ""
        if self.places is not None and self.places < FEW:
            return f"{said}: too few to tell how well."
        if self.spearman is not None:
            said += f"; rank correlation with what was measured {self.spearman:.2f}"
            if known(self.spearman_low) and known(self.spearman_high):
                said += f" ({self.spearman_low:.2f} to {self.spearman_high:.2f})"
        if known(self.level_low) and known(self.level_high):
            levels = f"{self.level_low:.2g} to {self.level_high:.2g}"
            said += f"; by lidar estimates are {levels} times the errors"
        if self.coverage is not None:
            said += f"; {percent(self.coverage, 0)} of the measured errors lay in their interval"
        return f"{said}."

    def _error(self) -> str:
        if self.mae is None:
            return "How far off an estimate is on average is not known."
        share = "" if self.share is None else f", {percent(self.share, 0)} of the median estimate"
        where = "" if self.mae_of == self.checked else f" ({self.mae_of})"
        return f"An estimate is off by {cm_about(self.mae, 2)} on average{share}{where}."

    def _interval(self) -> str:
        if not (known(self.median) and known(self.low) and known(self.high)):
            return "The estimates have no interval." if known(self.median) else ""
        median, low, high = (cm_about(x, self.digits) for x in (self.median, self.low, self.high))
        interval = f"{percent(LEVEL, 0)} interval from {low} to {high}"
        return f"The median estimate, {median}, has its {interval}."

    def _outside(self) -> str:
        if not self.outside:
            return ""
        return f"{percent(self.outside, 0)} of the places are unlike those that it was trained on."


def _count(number: int | None, name: str) -> str:
    if not number:
        return ""
    return count_of(number, name)

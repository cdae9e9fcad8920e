"""Between evaluated places: estimates that are interpolated along the route."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tilestream.factors.stations import INTERPOLATED
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.training import ESTIMATES, PREDICTION_COLUMNS
from tilestream.records import Float64, Int64

NAMES = tuple(ESTIMATES.values())
"""What is interpolated; intervals are of evaluated places only."""
ALONE = "from a virtual drive of its own, without all that its estimate averages"
"""Why a place with a virtual drive counts as interpolated."""


@dataclass(frozen=True, eq=False)
class Between:
    """The stretches of routes over which the places of a tile are interpolated."""

    route_ids: tuple[str, ...]
    """(k,) the route of each, those of a route together and along it."""
    ends: Int64
    """(k, 2) the sample points before and behind it, where a virtual drive was taken."""
    whole: NDArray[np.bool_]
    """(k,) whether that behind it has its whole kernel and is evaluated; else it is the last place
    of the stretch, with the estimate of as much of its kernel as is taken."""
    estimates: Float64
    """(k, 2, t) their estimates, in the order of `NAMES`."""

    def of(self, places: pd.DataFrame) -> Int64:
        """(n,) the stretch that each place lies in; -1: in none.

        Args:
            places: with `route_id` and `sample`.
        """
        found = np.full(len(places), -1)
        names, sample = np.array(self.route_ids), places["sample"].to_numpy(np.int64)
        for route_id, rows in places.groupby("route_id", sort=False).indices.items():
            own = np.flatnonzero(names == route_id)
            begin = self.ends[own, 0]
            end = self.ends[own, 1] - self.whole[own]  # the last place in it
            last = np.searchsorted(begin, sample[rows]) - 1  # of those that begin before it
            inside = (last >= 0) & (sample[rows] <= np.append(end, -1)[last])
            found[rows[inside]] = own[last[inside]]
        return found

    def filled(
        self,
        places: pd.DataFrame,
        there: NDArray[np.bool_],
        evaluated: Callable[[pd.DataFrame], pd.DataFrame],
    ) -> pd.DataFrame:
        """The estimates of places, on their index: interpolated in the stretches, without interval
        and covariance, and evaluated elsewhere.

        Args:
            places: with `route_id`, `sample`, `status` and `reason`.
            there: (n,) which of them have the factors of the map; the others have no estimate.
            evaluated: the estimates of some of the places.
        """
        which = self.of(places)
        parts, inside = [], which >= 0
        if not inside.all():
            parts.append(evaluated(places[~inside]).astype({"in_domain": "boolean"}))
        if inside.any():
            found = self._interpolated(places[inside], which[inside])
            lost = places[inside & ~there]
            found.loc[lost.index, list(NAMES)] = np.nan
            found.loc[lost.index, ["status", "reason"]] = lost[["status", "reason"]]
            parts.append(found)
        return pd.concat(parts).reindex(places.index)

    def _interpolated(self, places: pd.DataFrame, which: Int64) -> pd.DataFrame:
        """Of places in the stretches."""
        ends = self.ends[which]
        sample = places["sample"].to_numpy(np.int64)
        share = ((sample - ends[:, 0]) / (ends[:, 1] - ends[:, 0]))[:, None]
        before, behind = self.estimates[which].transpose(1, 0, 2)
        values = before * (1.0 - share) + behind * share  # at an end its own, to the bit
        told = [
            ALONE if at == b else f"interpolated between sample points {a} and {b}"
            for at, (a, b) in zip(sample.tolist(), ends.tolist(), strict=True)
        ]
        found = pd.DataFrame(values, index=places.index, columns=list(NAMES))
        names = [column.name for column in (*PREDICTION_COLUMNS, *COVARIANCE_COLUMNS)]
        found = found.reindex(columns=names).astype({"in_domain": "boolean"})
        return found.assign(status=INTERPOLATED, reason=told)

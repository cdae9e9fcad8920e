"""What makes the estimates of a run: a model that is there, one trained here, the virtual drive."""

from collections.abc import Mapping
from dataclasses import dataclass

from tilestream.errors import ModelError
from tilestream.model.applicability import check_making
from tilestream.model.dataset import POINTS_MIN, WITHOUT_DRIVES
from tilestream.model.file import load_model
from tilestream.model.registry import UNTRAINED
from tilestream.model.shipped import SHIPPED, file_of, is_shipped
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_settings import RunSettings

LABELS = "labels"
"""What it is filed under that there are too few labels to train on."""

OTHER_LIDAR = "of another lidar than the vehicle's"
UNFIT = "which does not fit the map"
"""Why a drive may train nothing."""
NONE_ASIDE: Mapping[str, str] = {}
"""All drives train."""


@dataclass(frozen=True)
class Estimator:
    """What makes the estimates of a run: a model, else the virtual drive as it is."""

    use: str | None = None
    """A model that is there: its file, or `shipped`."""
    trained: bool = False
    """Whether a model is trained on the drives of the run."""
    few: str = ""
    """Why none is trained, where the drives were to train one; else empty."""

    @property
    def untrained(self) -> bool:
        """Whether the virtual drive as it is makes the estimates."""
        return self.use is None and not self.trained


def estimator_of(
    settings: RunSettings, labelled: int, aside: Mapping[str, str] = NONE_ASIDE
) -> Estimator:
    """What makes the estimates, as soon as it is known how many places are measured.

    With too few of them to train on, the model that ships does, if it fits the job; else the
    virtual drive as it is. A job without a virtual drive has neither: training says that it cannot.

    Args:
        settings: the job.
        labelled: how many places are measured that may train.
        aside: the drives that train nothing, and why, in words.
    """
    model = settings.model
    if model.use is not None:
        return Estimator(use=model.use)
    if model.untrained(labelled):
        return Estimator()
    if labelled >= POINTS_MIN or settings.observe is None:
        return Estimator(trained=True)
    few = f"{labelled} labels, {POINTS_MIN} are needed to train {model.recipe}"
    if aside:
        few += f" (not counted: {'; '.join(f'{name}, {why}' for name, why in aside.items())})"
    more = "to train, measure longer drives, or more of them, or places nearer to each other; "
    more += WITHOUT_DRIVES
    unfit = _unfit(settings)
    if unfit:
        told = f"the estimates are the virtual drive as it is (model {UNTRAINED}), since {unfit}"
        return Estimator(few=f"{few}: {told}; {more}")
    return Estimator(SHIPPED, few=f"{few}: the estimates are those of the model that ships; {more}")


def _unfit(settings: RunSettings) -> str:
    """Why the model that ships cannot estimate the places of a job; empty: it can."""
    if not is_shipped():
        return "no model comes with this installation"
    try:
        check_making(load_model(file_of(SHIPPED)), making_of(settings))
    except ModelError as error:
        return f"the model that ships is for other jobs: {error}"
    return ""

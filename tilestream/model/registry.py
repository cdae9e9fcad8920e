"""All regressors by name: settings, evaluations, reports and model files choose from these.

A new one is a file of its own and a line here.
"""

from tilestream.model.baselines import OPPONENTS, PAPERS_OTHERS
from tilestream.model.corrected import Corrected
from tilestream.model.forest import PaperForest, TunedForest
from tilestream.model.physics import Physics
from tilestream.model.regressor import Estimator, Regressor

REGRESSORS: dict[str, type[Regressor]] = {
    one.name: one for one in (PaperForest, TunedForest, Physics, Corrected)
}
"""Those that are trained and kept in a file: what `model.recipe` may be."""
DEFAULT = Corrected.name
"""The one that a job trains unless `model.recipe` says otherwise."""
UNTRAINED = Physics.name
"""The one that needs no training: the virtual drive as it is."""
OF_VIRTUAL_DRIVES = (Physics.name, Corrected.name)
"""Those that need the virtual drive."""
_ALL: tuple[type[Estimator], ...] = (*REGRESSORS.values(), *PAPERS_OTHERS, *OPPONENTS)
COMPETITORS = {one.name: one for one in _ALL}
"""All that evaluations compare, in the order of their tables."""

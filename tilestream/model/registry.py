"""All regressors by name: settings, evaluations, reports and model files choose from these.

A new one is a file of its own and a line here.
"""

from tilestream.model.baselines import OPPONENTS, PAPERS_OTHERS
from tilestream.model.forest import DefaultForest, PaperForest
from tilestream.model.physics import Physics
from tilestream.model.regressor import Estimator, Regressor

REGRESSORS: dict[str, type[Regressor]] = {one.name: one for one in (PaperForest, DefaultForest)}
"""Those that are trained and kept in a file."""
DEFAULT = DefaultForest.name
"""The one that a job trains unless `model.recipe` says otherwise."""
UNTRAINED = Physics.name
"""The one that needs no training: the virtual drive as it is."""
RECIPES = (*REGRESSORS, UNTRAINED)
"""What `model.recipe` may be."""
_ALL: tuple[type[Estimator], ...] = (*REGRESSORS.values(), *PAPERS_OTHERS, *OPPONENTS, Physics)
COMPETITORS = {one.name: one for one in _ALL}
"""All that evaluations compare, in the order of their tables."""

"""What columns mean: of the page's tables in plain words, of the places as the definitions say."""

from tilestream.factors import catalogue, observability
from tilestream.factors.rows import PLACE_COLUMNS
from tilestream.model.covariance import COVARIANCE_COLUMNS
from tilestream.model.features import SPREAD_ACROSS, SPREAD_ALONG, WEAK_ALONG
from tilestream.model.figures import SEGMENT
from tilestream.model.training import PREDICTION_COLUMNS
from tilestream.report.measured import MEASURED_COLUMNS

COLUMNS = {
    "estimate": "The mean 3D error that scan matching is expected to have there, over starts up to "
    "some metres away (estimate in the files).",
    "interval": "Nine of ten measured errors are to lie in it (low, high).",
    "starts that fail": "The share of starts that end more than 0.5 m off (p_fail).",
    "like training": "Whether the place, the lidar and the matcher are like those that the model "
    "was trained on; elsewhere estimates are less certain (in_domain).",
    "why": "What is there that goes with large errors, and how it is at other places (reason).",
    "why at its worst": "The same of its worst place.",
    "unlike": "The share of the places that are unlike the training places (in_domain).",
    "95 %": "95 of 100 places are estimated below this.",
    "worst": "The highest error of the stretch, estimated or measured.",
    "MAE": "By how much estimates are off on average: the mean absolute error.",
    "RMSE": "The same with large misses weighing more: the root of the mean squared error.",
    "< 2.5 cm": "The share of the estimates that are off by less.",
    "< 5 cm": "The share of the estimates that are off by less.",
    "R²": "The share of the variance that the estimates explain, as the paper tells it.",
    "skill": "By how much the mean absolute error is smaller than that of the training places' "
    "median everywhere: 0 knows nothing, 1 everything.",
    "Spearman": "Rank correlation: whether worse places are told from better ones, whatever the "
    "level.",
    "skill, 12 m": f"The skill of means over {SEGMENT:g} m of road.",
    "Spearman, 12 m": f"The rank correlation of means over {SEGMENT:g} m of road.",
    "MAE smaller by": "Positive: the model in use is off by less.",
    "skill larger by": "Positive: the model in use knows more.",
    "promised": "The share of the measured errors that the intervals are made to hold.",
    "held": "The share that they held on paths that they were not calibrated on.",
    "importance": "The share of what the trees explain of their training points that is due to it.",
    "mean error grows by": "How much worse unseen blocks are estimated when all its factors are "
    "shuffled.",
    "selected": "Scans that the settings take.",
    "with a pose": "Scans whose true pose is known.",
    "sample points": "Places along the drive where errors are measured.",
}
"""By what stands above the column."""
CATALOGUE = {
    column.name: column
    for column in (
        *PLACE_COLUMNS,
        *catalogue.COLUMNS,
        *MEASURED_COLUMNS,
        WEAK_ALONG,
        SPREAD_ALONG,
        SPREAD_ACROSS,
        *observability.COLUMNS,
        *PREDICTION_COLUMNS,
        *COVARIANCE_COLUMNS,
    )
}
"""What each column of the places means."""

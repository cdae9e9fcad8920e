"""Trees of scikit-learn, one by one: their sum, what each factor adds to it, and their check.

Contributions and the check read the arrays of each `tree_`, as scikit-learn's guide to the
structure of trees does: no method gives the values of inner nodes.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.tree import DecisionTreeRegressor

from tilestream.model.dataset import matrix
from tilestream.records import Float64

TREE_TYPES = frozenset({"sklearn.tree._classes.DecisionTreeRegressor", "sklearn.tree._tree.Tree"})
"""What skops builds to read a tree."""
Float32: TypeAlias = NDArray[np.float32]


def float32_of(places: pd.DataFrame, factors: Sequence[str]) -> Float32:
    """(n, f) these factors of n places, as trees read them."""
    return np.ascontiguousarray(matrix(places, factors), np.float32)


def sum_of(trees: Sequence[DecisionTreeRegressor], X: Float32) -> Float64:
    """(n,) sum of what trees say, added in their order: each row has the same bits in any company.

    Args:
        trees: fitted.
        X: (n, f) places, contiguous.
    """
    total = np.zeros(len(X))
    for tree in trees:
        total += tree.predict(X, check_input=False)
    return total


def added_by_factors(trees: Sequence[DecisionTreeRegressor], X: Float32) -> Float64:
    """(n, f) what each factor adds along the paths through trees, summed over the trees.

    On the way from root to leaf, a step changes the value of the node at hand; the change belongs
    to the factor that the node compares (Saabas 2014). The sum over the factors, plus the sum over
    the roots, is the sum of what the trees say.
    """
    total = np.zeros(X.shape)
    for estimator in trees:
        tree = estimator.tree_
        value = tree.value[:, 0, 0]
        inner = np.flatnonzero(tree.children_left >= 0)
        change, factor = np.zeros(tree.node_count), np.zeros(tree.node_count, np.int64)
        for child in (tree.children_left[inner], tree.children_right[inner]):
            change[child], factor[child] = value[child] - value[inner], tree.feature[inner]
        paths = estimator.decision_path(X, check_input=False)
        row = np.repeat(np.arange(len(X)), np.diff(paths.indptr))
        place = row * X.shape[1] + factor[paths.indices]
        total += np.bincount(place, change[paths.indices], X.size).reshape(X.shape)
    return total


def leads_somewhere(tree: Any, factors: int) -> bool:
    """Whether every path through a tree ends, and compares only factors that exist: scikit-learn
    walks trees without checking.
    """
    nodes = np.arange(tree.node_count)
    left, right = tree.children_left, tree.children_right
    inner = left >= 0
    return (
        tree.node_count > 0
        and tree.n_features == factors
        and tree.value.shape == (tree.node_count, 1, 1)
        and bool(((left < 0) == (right < 0)).all())
        # Children come after their parent, so every walk ends.
        and bool((np.minimum(left, right) > nodes)[inner].all())
        and bool((np.maximum(left, right) < tree.node_count)[inner].all())
        and bool(((tree.feature >= 0) & (tree.feature < factors))[inner].all())
        and bool(np.isfinite(tree.value).all())
    )

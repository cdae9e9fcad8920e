"""A model is one file: a skops archive of exactly these types, with all that it depends on inside.

Reading one runs nothing from it: types are compared with a list before anything is built, and each
regressor checks what it is built from (`Regressor.load`). It unpacks to no more than a model would.
"""

import io
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import sklearn
import skops
import skops.io

from tilestream.errors import ModelError, SourceNotFoundError, foreign_errors
from tilestream.factors.along_route import WIDTHS
from tilestream.files import Files
from tilestream.model.covariance import as_json, from_json
from tilestream.model.domain import Domain
from tilestream.model.explain import Typical
from tilestream.model.intervals import Interval
from tilestream.model.registry import REGRESSORS
from tilestream.model.training import Model
from tilestream.version import VERSION

FORMAT = "tilestream model"
FORMAT_VERSION = 3
"""Raise it when a model of an older file would be read wrongly."""
CONTAINERS = frozenset(
    {
        "builtins.dict",
        "builtins.list",
        "builtins.str",
        "builtins.tuple",
        "numpy.ndarray",
    }
)
"""What every model file is built of."""
TYPES = CONTAINERS.union(*(regressor.types for regressor in REGRESSORS.values()))
"""Every type that a model file may name."""
TYPICAL = ("middle", "below", "above", "rho")
"""The arrays of `Typical`, one number per factor."""
SCHEMA = "schema.json"
"""What skops calls its list of types; every other member is an array."""
SCHEMA_MAX = 1 << 26
"""Longest schema that is read [bytes]: one of 2,000 trees takes 12 MB."""
NODES_MAX = 500_000
"""Most lists and mappings in it: one of 2,000 trees has 42,000."""
HEADER_MAX = 600
"""Longest description of an array [bytes]: one of a tree's nodes takes 310."""
RATIO_MAX = 20
"""A model unpacks to at most so many times its file, a schema on top: forests take 4 to 6 times."""


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write a model in one piece: a file that is there is whole.

    Args:
        model: what to write.
        path: a local path or any fsspec URL; a file there is replaced.
    """
    facts = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "tilestream": VERSION,
        "sklearn": sklearn.__version__,
        "numpy": np.__version__,
        "skops": skops.__version__,
        "factors": list(model.factors),
        "made_with": dict(model.made_with),
        "data_set": dict(model.data_set),
        "interval": {k: None if v != v else v for k, v in asdict(model.interval).items()},
        "threshold": model.domain.threshold,
        "typical": {name: getattr(model.typical, name) for name in ("names", "units", "clear")},
        "width": model.width,
        "worst": model.worst,
        "facts": dict(model.facts),
        "card": dict(model.card),
        "covariance": None if model.covariance is None else as_json(model.covariance),
    }
    content = {  # "forests" is what version 0.1 calls the regressors
        "facts": json.dumps(facts, sort_keys=True),
        "forests": {target: one.save() for target, one in model.regressors.items()},
        "domain": {
            "middle": model.domain.middle,
            "scale": model.domain.scale,
            "whitening": model.domain.whitening,
        },
        "typical": {name: getattr(model.typical, name) for name in TYPICAL},
    }
    packed = skops.io.dumps(content, compression=zipfile.ZIP_DEFLATED, compresslevel=6)
    Files.at(path).write(packed)


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model; nothing in the file is executed.

    Raises:
        SourceNotFoundError: no file there.
        ModelError: no model of tilestream, a damaged one, one that names other types (they are
            listed), or one of another version of the format or of scikit-learn.
    """
    place = Files.at(path).address
    try:
        packed = Files.at(path).read()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise SourceNotFoundError(f"{place}: no such model file") from None
    with foreign_errors(ModelError, f"{place}: no model file of tilestream", "train it again"):
        data, schema = _unpacked(packed)
        others = sorted(set(_types(schema)) - TYPES)
    if others:
        raise ModelError(
            f"{place}: refused, since it names types that no model of tilestream has: "
            f"{', '.join(others)}"
        )
    with foreign_errors(ModelError, f"{place}: a damaged model file", "train it again"):
        content = skops.io.loads(data, trusted=sorted(TYPES))
        facts = json.loads(content["facts"])
        _refuse_other_versions(place, facts)
        return _model(content, facts)


def _unpacked(data: bytes) -> tuple[bytes, Any]:
    """The same archive without compression, and its schema: `zipfile`, as skops calls it, unpacks
    all that a member holds, whatever size it claims.
    """
    plain = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(plain, "w") as target:
        members = {info.filename: info for info in archive.infolist()}
        if len(members) < len(archive.infolist()):
            raise ValueError("a member is there twice")
        for info in members.values():
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{info.filename} is compressed by another method than deflate")
        claimed = sum(info.file_size for info in members.values())
        if members[SCHEMA].file_size > SCHEMA_MAX or claimed > SCHEMA_MAX + RATIO_MAX * len(data):
            raise ValueError(f"claims to unpack to {claimed} bytes, more than a model would")
        for name, info in members.items():
            with archive.open(info) as member:
                content = member.read(info.file_size)
            if name == SCHEMA:
                schema = content
            else:
                _check_array(name, content)
            target.writestr(name, content)
    if schema.count(b"{") + schema.count(b"[") > NODES_MAX:
        raise ValueError(f"its schema has more than {NODES_MAX} parts")
    return plain.getvalue(), json.loads(schema)


def _check_array(name: str, content: bytes) -> None:
    """Refuse an array that claims to be larger than its member, or smaller."""
    file = io.BytesIO(content)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name} is no array of NumPy's format 1.0")
    shape, _, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=HEADER_MAX)
    if math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"{name} claims to be an array of shape {shape} of {dtype}, and is not")


def _types(node: Any) -> Iterator[str]:
    """Every type that a skops schema names."""
    if isinstance(node, dict):
        if "__class__" in node or "__module__" in node:
            yield f"{node.get('__module__')}.{node.get('__class__')}"
        for value in node.values():
            yield from _types(value)
    elif isinstance(node, list):
        for value in node:
            yield from _types(value)


def _refuse_other_versions(place: str, facts: Mapping[str, Any]) -> None:
    if facts.get("format") != FORMAT:
        raise ModelError(f"{place}: no model of tilestream")
    if facts["format_version"] != FORMAT_VERSION:
        raise ModelError(
            f"{place}: of format {facts['format_version']}, and this tilestream ({VERSION}) reads "
            f"{FORMAT_VERSION}: train it again"
        )
    recipe = REGRESSORS.get(facts["facts"]["recipe"])
    if recipe is not None and not recipe.types:  # numbers alone, which any version reads
        return
    written, here = (v.split(".")[:2] for v in (facts["sklearn"], sklearn.__version__))
    if written != here:
        raise ModelError(
            f"{place}: its regressors are of scikit-learn {facts['sklearn']}, here is "
            f"{sklearn.__version__}: train it again, or install that version"
        )


def _model(content: Mapping[str, Any], facts: Mapping[str, Any]) -> Model:
    names = tuple(str(name) for name in facts["factors"])
    recipe, settings = facts["facts"]["recipe"], facts["facts"]
    if recipe not in REGRESSORS:
        raise ModelError(
            f"a model of {recipe!r}, and this tilestream has {', '.join(sorted(REGRESSORS))}: "
            "train it again"
        )
    regressors = {
        target: REGRESSORS[recipe].load(saved, target, names, settings)
        for target, saved in content["forests"].items()
    }
    arrays = {name: np.asarray(a, np.float64) for name, a in content["domain"].items()}
    shapes = {"middle": (len(names),), "scale": (len(names),), "whitening": (len(names),) * 2}
    if {name: array.shape for name, array in arrays.items()} != shapes:
        raise ModelError("a damaged model file: its domain has not its factors")
    typical = {name: np.asarray(content["typical"][name], np.float64) for name in TYPICAL}
    known, units = (tuple(str(text) for text in facts["typical"][k]) for k in ("names", "units"))
    if {len(units), *(a.size for a in typical.values())} != {len(known)} or set(names) - set(known):
        raise ModelError("a damaged model file: what is typical is not of its factors")
    if facts["width"] not in WIDTHS:
        raise ModelError(f"a damaged model file: no width of averages is {facts['width']!r}")
    level, constant, below, above = (
        float("nan") if facts["interval"][k] is None else float(facts["interval"][k])
        for k in ("level", "constant", "below", "above")
    )
    return Model(
        regressors=regressors,
        domain=Domain(**arrays, threshold=float(facts["threshold"])),
        typical=Typical(known, units, **typical, clear=float(facts["typical"]["clear"])),
        interval=Interval(level, constant, below, above, int(facts["interval"]["blocks"])),
        factors=names,
        made_with=facts["made_with"],
        data_set=facts["data_set"],
        width=float(facts["width"]),
        worst=float(facts["worst"]),
        facts=facts["facts"],
        card=facts.get("card", {}),  # files of older versions have none
        covariance=from_json(facts["covariance"]) if facts.get("covariance") else None,  # neither
    )

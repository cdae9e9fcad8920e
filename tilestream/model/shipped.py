"""The model that comes with tilestream, by its name."""

from importlib import resources

from tilestream.errors import SourceNotFoundError

SHIPPED = "shipped"
"""What the model that ships is called where a model's file is named."""
DATA = resources.files("tilestream") / "data"
"""Where the files lie that ship."""
FILE = "model.skops"


def is_shipped() -> bool:
    """Whether a model comes with this installation."""
    return (DATA / FILE).is_file()


def file_of(use: str) -> str:
    """The file of a model in use: of `shipped` the one that comes with this installation.

    Raises:
        SourceNotFoundError: none does.
    """
    if use != SHIPPED:
        return use
    if not is_shipped():
        raise SourceNotFoundError(
            "no model comes with this installation of tilestream: name a model file, or take the "
            "virtual drive as it is (--model physics; in YAML model: {recipe: physics})"
        )
    return str(DATA / FILE)

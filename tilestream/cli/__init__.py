"""The command line: `commands` parse, call and print; the only room that exits."""

from tilestream.cli.commands import main as main
from tilestream.cli.commands import run as run

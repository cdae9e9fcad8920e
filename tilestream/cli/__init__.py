"""The command line: `app` lists the commands, each group of them has a file."""

from tilestream.cli.app import main as main
from tilestream.cli.app import run as run

"""The version of the code, recorded in every mark that a finished piece of work carries."""

VERSION = "0.2.0"

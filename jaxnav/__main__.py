"""``python -m jaxnav``: the command line."""

from jaxnav.cli import entry

entry()

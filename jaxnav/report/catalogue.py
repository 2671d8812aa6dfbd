"""What there is: studies, filters, wrappers, banks, weight rules, channels and data formats."""

from typing import get_args

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.estimation.models import Channel
from jaxnav.estimation.register import by_kind, functions_of, plain
from jaxnav.studies import STUDIES


def print_catalogue() -> None:
    """Print the studies, what there is to filter with, the channels and the data formats."""
    console = Console()
    table = Table(title="studies")
    table.add_column("study")
    table.add_column("scenario")
    table.add_column("what it is")
    for name, study in STUDIES.items():
        table.add_row(name, "", study.summary)
        for scenario, text in study.load("scenarios").items():
            table.add_row("", scenario, escape(text))
    console.print(table)
    for title, found in by_kind().items():
        _print(console, title, {name: entry.text for name, entry in found.items()})
    _print(console, "channels", _channels())
    console.print(
        "data formats: RTKLIB .pos (run gnss-track --log PATH), inertial CSV (allan PATH), drives "
        "as RTK folders, comma2k19 segments and CSV (filter PATH)",
        soft_wrap=True,
    )


def _channels() -> dict[str, str]:
    """Return what makes a channel, or several by name, with what it is."""
    return {
        function.__name__: plain(function.__doc__)
        for function, types in functions_of("jaxnav.navigation.channels")
        if Channel in (types.get("return"), *get_args(types.get("return")))
    }


def _print(console: Console, title: str, entries: dict[str, str]) -> None:
    listing = Table(title=title)
    listing.add_column("name")
    listing.add_column("what it is")
    for name, text in entries.items():
        listing.add_row(name, escape(text))
    console.print(listing)

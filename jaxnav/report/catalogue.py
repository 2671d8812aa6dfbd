"""What there is: studies, filters, weight rules and data formats."""

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.studies import STUDIES


def print_catalogue() -> None:
    """Print the studies, filters, weight rules and data formats."""
    from jaxnav.estimation import catalogue

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
    for title, entries in catalogue().items():
        listing = Table(title=title)
        listing.add_column("name")
        listing.add_column("what it is")
        for name, text in entries.items():
            listing.add_row(name, escape(text))
        console.print(listing)
    console.print(
        "data formats: RTKLIB .pos (run gnss-track --log PATH), inertial CSV (allan PATH), drives "
        "as RTK folders, comma2k19 segments and CSV (filter PATH)",
        soft_wrap=True,
    )

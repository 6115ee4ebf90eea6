"""A table of text for a terminal, a page of Markdown or one of HTML."""

from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable

STYLE: dict[str, Any] = {"box": SIMPLE_HEAD, "padding": (0, 0, 0, 1), "pad_edge": False}
NOTHING = "–"


class Table(NamedTuple):
    """A table of text.

    Attributes:
      title: above it.
      heads: of the columns.
      rows: cells, as many as heads; the first one names the row.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def to_markdown(self) -> str:
        """The table in Markdown, without its title."""
        rule = ("---", *["---:"] * (len(self.heads) - 1))
        return "\n".join(f"| {' | '.join(row)} |" for row in (self.heads, rule, *self.rows))

    def to_rich(self) -> RichTable:
        """The table for a terminal; in a narrow one, only the first column breaks within words."""
        table = RichTable(title=self.title, title_justify="left", **STYLE)
        table.add_column(self.heads[0], overflow="fold", min_width=len(self.heads[0]))
        for head, *cells in list(zip(self.heads, *self.rows, strict=True))[1:]:
            width = max(len(word) for cell in (head, *cells) for word in cell.split())
            table.add_column(head, justify="right", min_width=width)
        for row in self.rows:
            table.add_row(*row)
        return table


def number(value: float | None, form: str) -> str:
    """A number in this format; `NOTHING` for none."""
    return NOTHING if value is None else format(value, form)

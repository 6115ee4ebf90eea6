"""The tables of the experiments, our numbers beside the paper's, as text for any place.

Source: paper Tables 1 and 2; agent specification "Experiments".
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from rich.table import Table as RichTable

from agents.runs.report import TABLE_STYLE, duration

Record = Mapping[str, Any]


class Spread(NamedTuple):
    """A mean and a standard deviation, None where the paper gives none."""

    mean: float
    sd: float | None = None


class PaperSolved(NamedTuple):
    """A row of the paper's Table 1: trials that solved the task, and episodes to solve it."""

    solved: int
    trials: int
    episodes: Spread | None


PAPER_SOLVED = {
    "ppo": PaperSolved(0, 5, None),
    "ppo+icm": PaperSolved(5, 5, Spread(102_000, 60_000)),
}

# Table 2: percent of tasks solved.
PAPER_PERCENT: dict[str, dict[str, Spread]] = {
    "ppo": {
        "p": Spread(0),
        "st": Spread(0),
        "sy": Spread(35.5, 10.9),
        "pst": Spread(0),
        "psy": Spread(7, 3.6),
        "stsy": Spread(19.4, 3.2),
        "pstsy": Spread(4.4, 3.2),
    },
    "ppo+icm": {
        "p": Spread(2, 3),
        "st": Spread(0),
        "sy": Spread(40.2, 16.9),
        "pst": Spread(0),
        "psy": Spread(29.7, 8.1),
        "stsy": Spread(33.1, 19.7),
        "pstsy": Spread(24.4, 9),
    },
}

LABELS = {"ppo": "PPO", "ppo+icm": "PPO + ICM"}
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
        """The table for a terminal."""
        table = RichTable(title=self.title, title_justify="left", **TABLE_STYLE)
        for index, head in enumerate(self.heads):
            width = max(map(len, head.split()))
            table.add_column(head, justify="right" if index else "left", min_width=width)
        for row in self.rows:
            table.add_row(*row)
        return table


def tables(record: Record) -> list[Table]:
    """All tables of an experiment's record."""
    made = [solved_table(record)] if record["experiment"] == "exp1" else []
    evaluated = [entry for entry in record["algorithms"] if entry["aggregate"]["sets"]]
    if evaluated:
        made.append(percent_table(record))
    made += [
        quality_table(record, entry)
        for entry in evaluated
        if any(score["percent_of_solvable"] for score in entry["aggregate"]["sets"])
    ]
    return [*made, cost_table(record)]


def solved_table(record: Record) -> Table:
    """Our rows above those of the paper's Table 1."""
    rows = []
    for entry in record["algorithms"]:
        found = entry["aggregate"]
        trials = f"{found['solved']} / {found['trials']}"
        rows.append((_label(record, entry), trials, _thousands(found["episodes_to_solve"])))
    for name, paper in PAPER_SOLVED.items():
        episodes = paper.episodes._asdict() if paper.episodes else None
        trials = f"{paper.solved} / {paper.trials}"
        rows.append((f"{LABELS[name]}, paper", trials, _thousands(episodes)))
    heads = ("algorithm", "trials solved", "episodes to solve")
    title = "Base task solved; episodes to solve it, mean ± sd over the trials that did"
    return Table(title, heads, tuple(rows))


def percent_table(record: Record) -> Table:
    """Percent of tasks solved of each set; for experiment 2 with the columns of Table 2.

    Of experiment 1 the paper says that agents solve what happens to equal the base task: the
    share of such tasks stands beside theirs.
    """
    ranked = f"mean of {len(record['ranked'])}"
    columns: dict[str, dict[str, str]] = {}
    labels: dict[str, str] = {}
    for entry in record["algorithms"]:
        scores = {score["set"]: score for score in entry["aggregate"]["sets"]}
        labels |= {name: score["label"] for name, score in scores.items()}
        cells = {name: _spread(score["percent"]) for name, score in scores.items()}
        columns[_label(record, entry)] = {**cells, ranked: _spread(entry["aggregate"]["overall"])}
    for name, paper in PAPER_PERCENT.items() if record["experiment"] == "exp2" else ():
        columns[f"{LABELS[name]}, paper"] = {
            name: _spread(spread._asdict()) for name, spread in paper.items()
        }
    if record["experiment"] == "exp1":
        equal = record["equal_to_base"].items()
        columns["equal to base"] = {name: f"{percent:.1f}" for name, percent in equal}
    rows = [
        (label, *(cells.get(name, NOTHING) for cells in columns.values()))
        for name, label in {**labels, ranked: ranked}.items()
    ]
    title = "Tasks solved at the best overall evaluation, %, mean ± sd over trials"
    return Table(title, ("set", *columns), tuple(rows))


def quality_table(record: Record, entry: Record) -> Table:
    """How good an algorithm's play is: solvable tasks solved, shortest plan / steps taken."""
    rows = [
        (
            score["label"],
            str(score["tasks"]),
            _spread(score["percent"]),
            _spread(score["percent_of_solvable"]),
            _spread(score["optimality"], ".3f"),
            _number(score["worst"], ".3f"),
        )
        for score in entry["aggregate"]["sets"]
    ]
    heads = ("set", "tasks", "solved %", "of solvable %", "optimality", "worst")
    title = f"{_label(record, entry)}: optimality is shortest plan / steps taken, where solved"
    return Table(title, heads, tuple(rows))


def cost_table(record: Record) -> Table:
    """How long the training was."""
    everything = [entry["aggregate"] for entry in record["algorithms"]]
    whole = any(found.get("process_seconds") for found in everything)
    rows = []
    for entry, found in zip(record["algorithms"], everything, strict=True):
        iterations = sorted({run["iterations"] for run in entry["runs"]})
        cells = [
            _label(record, entry),
            str(found["trials"]),
            "–".join(f"{count:,}" for count in dict.fromkeys((iterations[0], iterations[-1]))),
            f"{found['transitions']['mean']:,.0f}",
        ]
        cells.append(duration(found["training_seconds"]["mean"]))
        if whole:
            process = found.get("process_seconds")
            cells.append(duration(process["mean"]) if process else NOTHING)
        rows.append(tuple(cells))
    heads = ["algorithm", "trials", "iterations", "transitions"]
    heads += ["training time"] + ["with start-up"] * whole
    return Table("What a trial took, on average", tuple(heads), tuple(rows))


def notes(record: Record) -> list[str]:
    """What has to be said beside the tables: the command, where it ran, what is unfinished."""
    lines = [f"`{record['command']}`", *provenance(record)]
    for entry in record["algorithms"]:
        for run in entry["runs"]:
            if not run["finished"]:
                far = f"{run['iterations']} of {run['of']} iterations"
                lines.append(f"Unfinished: {entry['name']}, seed {run['seed']}, {far}.")
    return lines


def provenance(record: Record) -> list[str]:
    """Each machine, with versions and commit, that runs of the record ran on."""
    machines: dict[str, None] = {}
    for entry in record["algorithms"]:
        for run in entry["runs"]:
            for machine in run["machines"]:
                machines[_machine(machine)] = None
    return list(machines)


def markdown(record: Record) -> str:
    """All tables and notes in Markdown."""
    parts = [f"**{table.title}**\n\n{table.to_markdown()}" for table in tables(record)]
    return "\n\n".join([*parts, *notes(record)])


def _machine(machine: Mapping[str, Any]) -> str:
    where = f"{machine['cores']} cores of {machine['processor']}"
    if machine["device"].lower() != "cpu":
        where = f"{machine['devices']} {machine['device']}, {where}"
    commit = machine["commit"] or "unknown"
    return f"Ran on {where}; jax {machine['jax']}, commit `{commit}`."


def _label(record: Record, entry: Record) -> str:
    if entry["name"] == "preset":
        return str(record["preset"])
    name = str(entry["name"])
    return LABELS.get(name, name)


def _spread(spread: Mapping[str, float | None] | None, form: str = ".1f") -> str:
    if spread is None:
        return NOTHING
    sd = "" if spread["sd"] is None else f" ± {spread['sd']:{form}}"
    return f"{spread['mean']:{form}}{sd}"


def _thousands(spread: Mapping[str, float | None] | None) -> str:
    return _spread(spread, ",.0f")


def _number(value: float | None, form: str) -> str:
    return NOTHING if value is None else format(value, form)

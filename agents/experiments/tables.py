"""The tables of the experiments, our numbers beside the paper's, as text for any place.

Source: paper Tables 1 and 2.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean

from agents.experiments import statistics
from agents.experiments.protocol import PRESET, PROTOCOLS
from agents.experiments.records import Record
from agents.experiments.statistics import SetSummary, Spread
from agents.runs.report import FEW_LAYOUTS, duration
from agents.runs.table import NOTHING, Table, number
from trap_tube_jax.scoring.scores import Layouts
from trap_tube_jax.scoring.tasks import ALL_SETS, label

# Table 1: trials that solved the task, and episodes to solve it.
PAPER_SOLVED = {"ppo": ("0 / 5", None), "ppo+icm": ("5 / 5", Spread(102_000, 60_000))}

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

TITLES = {
    "exp1": "Experiment 1: train on base",
    "exp2": "Experiment 2: train on {P, St, Sy}",
}
LABELS = {"ppo": "PPO", "ppo+icm": "PPO + ICM"}
INTERVAL = "[95 % confidence interval of the mean, Student t over seeds]"
SPREAD = f"mean ± sd {INTERVAL}"
MOST_COLUMNS = 4  # of algorithms beside each other; more of them are rows
MEAN_OF_SETS = "mean of the sets apart from base"


def tables(record: Record) -> list[Table]:
    """All tables of an experiment's record."""
    made = [solved_table(record)] if record["experiment"] == "exp1" else []
    evaluated = [entry for entry in record["algorithms"] if statistics.tested(entry)]
    if evaluated:
        made.append(percent_table(record))
        made += intervals_table(record)
    if any(about["layout"] for about in record["sets"].values()) and evaluated:
        made.append(layouts_table(record))
    if any(about["shortest"] for about in record["sets"].values()):
        made += [quality_table(record, entry) for entry in evaluated]
    if any(len(entry["runs"]) > 1 for entry in evaluated):
        made.append(seeds_table(record))
    return [*made, cost_table(record)]


def title(record: Record) -> str:
    """What a record is of, for the head of a page or figure."""
    what = f"Train on {label(record['protocol']['train_set'])}"
    if is_of_paper(record):
        what = TITLES[record["experiment"]]
    return f"{what}, preset {record['protocol']['preset']}"


def is_of_paper(record: Record) -> bool:
    """Whether a record is of what the paper trained on, so that its numbers stand beside it."""
    return record["protocol"]["train_set"] == PROTOCOLS[record["experiment"]].train_set


def solved_table(record: Record) -> Table:
    """Our rows above those of the paper's Table 1."""
    rows = []
    for entry in record["algorithms"]:
        episodes = statistics.episodes_to_solve(entry)
        trials = f"{len(episodes)} / {len(entry['runs'])}"
        rows.append(
            (algorithm_label(record, entry), trials, spread_text(Spread.of(episodes), ",.0f"))
        )
    for name, (trials, paper) in PAPER_SOLVED.items() if is_of_paper(record) else ():
        rows.append((f"{LABELS[name]}, paper", trials, spread_text(paper, ",.0f")))
    heads = ("algorithm", "trials solved", "episodes to solve")
    what = "Base task" if is_of_paper(record) else label(record["protocol"]["train_set"])
    return Table(f"{what} solved; episodes to solve it, {SPREAD}", heads, tuple(rows))


def percent_table(record: Record) -> Table:
    """Percent of tasks solved of each set; for experiment 2 with the columns of Table 2.

    Of experiment 1 the paper says that agents solve what happens to equal the base task: the
    share of such tasks stands beside theirs. Many algorithms are rows instead of columns, and
    their intervals are in `intervals_table`.
    """
    columns, selection = _percents(record), _selection(record)
    if len(columns) > MOST_COLUMNS:
        return _algorithm_rows(
            record, f"Tasks solved, %, mean ± sd. {selection}", _without_interval
        )
    rows = [
        (text, *(_percent(cells.get(name)) for cells in columns.values()))
        for name, text in _compared(record).items()
    ]
    return Table(f"Tasks solved, %, {SPREAD}. {selection}", ("set", *columns), tuple(rows))


def intervals_table(record: Record) -> list[Table]:
    """The intervals of the means of many algorithms, whose table is too wide for them; or none."""
    table = _algorithm_rows(record, f"Tasks solved, %: {INTERVAL.strip('[]')}", _interval)
    rows = tuple(row for row in table.rows if set(row[1:]) != {NOTHING})
    is_needed = len(table.rows) > MOST_COLUMNS and rows
    return [table._replace(rows=rows)] if is_needed else []


def _compared(record: Record) -> dict[str, str]:
    """The names of the sets, and of their mean, with what tables call them."""
    return {**{name: label(name) for name in record["sets"]}, MEAN_OF_SETS: MEAN_OF_SETS}


def _percents(record: Record) -> dict[str, Mapping[str, Spread | None]]:
    """Percent solved by algorithm, ours and the paper's, and then by set."""
    columns: dict[str, Mapping[str, Spread | None]] = {}
    for entry in _tested(record):
        summaries = statistics.by_set(record, entry)
        percents = {name: summary.percent for name, summary in summaries.items()}
        mean = statistics.mean_of_sets(record, entry)
        columns[algorithm_label(record, entry)] = {**percents, MEAN_OF_SETS: mean}
    with_paper = record["experiment"] == "exp2" and is_of_paper(record)
    for name, paper in PAPER_PERCENT.items() if with_paper else ():
        columns[f"{LABELS[name]}, paper"] = paper
    if record["experiment"] == "exp1":
        about = record["sets"].items()
        columns["equal to base"] = {name: Spread(each["equal_to_base"]) for name, each in about}
    return columns


def _algorithm_rows(record: Record, heading: str, text: Callable[[Spread | None], str]) -> Table:
    """Percent solved with a row for each algorithm."""
    labels = _compared(record)
    rows = [
        (algorithm, *(text(cells.get(name)) for name in labels))
        for algorithm, cells in _percents(record).items()
    ]
    return Table(heading, ("algorithm", *labels.values()), tuple(rows))


def layouts_table(record: Record) -> Table:
    """The layouts solved of the sets that have few of them."""
    found = {
        algorithm_label(record, entry): statistics.by_set(record, entry)
        for entry in _tested(record)
    }
    rows = [
        (label(name), *(_solved_layouts(each[name].layouts) for each in found.values()))
        for name, about in record["sets"].items()
        if about["layout"]
    ]
    heading = f"Layouts solved, mean over seeds. {FEW_LAYOUTS}"
    return Table(heading, ("set", *found), tuple(rows))


def quality_table(record: Record, entry: Record) -> Table:
    """How good an algorithm's play is: solvable tasks solved, shortest plan / steps taken."""
    rows = [
        (
            label(name),
            str(len(record["sets"][name]["shortest"] or ())),
            _percent(summary.percent_of_solvable),
            spread_text(summary.optimality, ".3f", high=1.0),
            number(summary.worst, ".3f"),
        )
        for name, summary in statistics.by_set(record, entry).items()
    ]
    heads = ("set", "tasks", "of solvable %", "optimality", "worst")
    algorithm = algorithm_label(record, entry)
    heading = (
        f"{algorithm}: optimality is shortest plan / steps taken, where solved; over "
        "the first tasks of each set"
    )
    return Table(heading, heads, tuple(rows))


def seeds_table(record: Record) -> Table:
    """What each seed solves, when its policy was chosen, and all steps that it took."""
    rows = []
    for entry in _tested(record):
        for run in statistics.tested(entry):
            scores = statistics.seed_scores(record, run)
            percents: list[float | None] = [score.percent for score in scores.values()]
            percents.append(statistics.mean_score(scores))
            cells = [number(percent, ".1f") for percent in percents]
            chosen = f"{run['best']['iteration']:,} of {run['iterations']:,}"
            transitions = f"{run['transitions']:,}"
            name = algorithm_label(record, entry)
            rows.append((name, str(run["seed"]), *cells, chosen, transitions))
    labels = map(label, record["sets"])
    heads = ("algorithm", "seed", *labels, MEAN_OF_SETS, "chosen at iteration", "transitions")
    return Table("Seed by seed: tasks solved, %", heads, tuple(rows))


def cost_table(record: Record) -> Table:
    """How long the training was."""
    rows = []
    for entry in record["algorithms"]:
        runs = entry["runs"]
        iterations = [run["iterations"] for run in runs]
        ends = dict.fromkeys((min(iterations), max(iterations)))
        rows.append(
            (
                algorithm_label(record, entry),
                str(len(runs)),
                "–".join(f"{count:,}" for count in ends),
                f"{fmean(run['transitions'] for run in runs):,.0f}",
                duration(fmean(run["training_seconds"] for run in runs)),
            )
        )
    heads = ("algorithm", "trials", "iterations", "transitions", "training time")
    return Table("What a trial took, on average", heads, tuple(rows))


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
    return list(dict.fromkeys(map(_machine, record["machines"])))


def summary_markdown(record: Record) -> str:
    """The paper's best agent above ours, in Markdown: percent solved of the sets of its Table 2.

    With the 95 % interval of the mean, or, of sets that have few layouts, the layouts solved.
    """
    paper = PAPER_PERCENT["ppo+icm"]
    names = [name for name in paper if name in record["sets"]]
    rows = [(f"{LABELS['ppo+icm']}, paper", *(f"{paper[name].mean:.1f}" for name in names))]
    for entry in _tested(record):
        found = statistics.by_set(record, entry)
        cells = (_percent_or_layouts(found[name]) for name in names)
        rows.append((algorithm_label(record, entry), *cells))
    return Table("", ("agent", *map(label, names)), tuple(rows)).to_markdown()


def leaderboard_cells(record: Record, seed: int | None = None) -> tuple[str, ...]:
    """A row of the leaderboard: percent solved of the paper's sets, tasks of a set, steps.

    Args:
      record: of one algorithm.
      seed: whose row it is; the means over all if absent.

    Raises:
      ValueError: the record has no such seed, or several algorithms.
    """
    if len(record["algorithms"]) != 1:
        raise ValueError("a row of the leaderboard is of one algorithm")
    entry = record["algorithms"][0]
    runs = [run for run in statistics.tested(entry) if seed in (None, run["seed"])]
    if not runs:
        raise ValueError(f"the record has no seed {seed}")
    found = statistics.by_set(record, {**entry, "runs": runs})
    means = [found[name].percent if name in found else None for name in ALL_SETS]
    tasks = max(map(len, runs[0]["best"]["steps"].values()))
    steps = fmean(run["transitions"] for run in runs)
    percents = (number(each and each.mean, ".1f") for each in means)
    return (*percents, f"{tasks:,}", f"{steps:,.0f}")


def markdown(record: Record) -> str:
    """All tables and notes in Markdown."""
    parts = [f"**{table.title}**\n\n{table.to_markdown()}" for table in tables(record)]
    return "\n\n".join([*parts, *notes(record)])


def _tested(record: Record) -> list[Record]:
    return [entry for entry in record["algorithms"] if statistics.tested(entry)]


def _selection(record: Record) -> str:
    """How the evaluation was chosen that the tables report."""
    protocol = record["protocol"]
    ranked = ", ".join(record["ranked"])
    if protocol["selection"] == "paper":
        return (
            f"Of each trial, the evaluation with the best mean over {ranked}, chosen and reported "
            f"on the same {protocol['tasks']} tasks a set, as in the paper"
        )
    return (
        f"Of each trial, the evaluation with the best mean over {ranked} on {protocol['tasks']} "
        f"validation tasks a set; reported are {protocol['reported']:,} other tasks a set"
    )


def _machine(machine: Record) -> str:
    cores = machine["cores"]
    where = f"{cores} core{'s' * (cores != 1)} of {machine['processor']}"
    if machine["device"].lower() != "cpu":
        where = f"{machine['devices']} {machine['device']}, {where}"
    commit = machine["commit"] or "unknown"
    return f"Ran on {where}; jax {machine['jax']}, commit `{commit}`."


def algorithm_label(record: Record, entry: Record) -> str:
    """What tables and figures call an algorithm: the preset's name where it is trained as it is."""
    name, comma, settings = str(entry["name"]).partition(",")
    known = {**LABELS, PRESET: str(record["protocol"]["preset"])}
    return f"{known.get(name, name)}{comma and ', '}{settings}"


def _percent(spread: Spread | None) -> str:
    return spread_text(spread, ".1f", high=100.0)


def spread_text(spread: Spread | None, form: str, high: float = math.inf) -> str:
    """Mean, deviation and interval, the last cut off at 0 and `high`, beyond which no mean lies."""
    if spread is None:
        return NOTHING
    text = format(spread.mean, form)
    if spread.sd is not None:
        text += f" ± {spread.sd:{form}}"
    if spread.margin is not None:
        text += f" {interval_text(spread, form, high)}"
    return text


def interval_text(spread: Spread | None, form: str, high: float = math.inf) -> str:
    """The interval alone, cut off as in `spread_text`."""
    if spread is None or spread.margin is None:
        return NOTHING
    ends = max(0.0, spread.mean - spread.margin), min(high, spread.mean + spread.margin)
    return f"[{ends[0]:{form}}, {ends[1]:{form}}]"


def _percent_or_layouts(found: SetSummary) -> str:
    if found.percent is None:
        return NOTHING
    if found.layouts:
        return f"{found.percent.mean:.1f} ({_solved_layouts(found.layouts)})"
    return _percent(found.percent._replace(sd=None))


def _without_interval(spread: Spread | None) -> str:
    return _percent(spread and spread._replace(margin=None))


def _interval(spread: Spread | None) -> str:
    return interval_text(spread, ".1f", high=100.0)


def _solved_layouts(layouts: Sequence[Layouts]) -> str:
    """How many are solved: a whole number where all seeds agree, else the mean."""
    counts = {each.solved for each in layouts}
    form = ".0f" if len(counts) == 1 else ".1f"
    return f"{fmean(each.solved for each in layouts):{form}} of {layouts[0].total}"

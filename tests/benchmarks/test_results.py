"""Numbers on pages: each follows from the records in benchmarks/results."""

import functools
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from agents.sweeps import tables
from helpers.paths import ROOT
from trap_tube_jax.scoring.scores import wilson_interval
from trap_tube_jax.scoring.tasks import ALL_SETS, label

RESULTS = ROOT / "benchmarks" / "results"


def rows_of(record: str, name: str) -> Any:
    return pd.read_csv(RESULTS / record / f"{name}.csv")


def percent_solved(record: str) -> Any:
    """Returns the percentages of a record: a row per algorithm and seed, a column per set."""
    return tables.by_set(tables.reported(rows_of(record, "results")))


def steps(record: str, algorithm: str | None = None) -> Any:
    """Returns the environment steps of a record's seeds."""
    rows = rows_of(record, "curves")
    if algorithm:
        rows = rows.query("algorithm == @algorithm")
    return rows.groupby("seed")["transitions"].max()


def cells(values: Any) -> str:
    return " | ".join(f"{value:.1f}" for value in values)


def means(percent: Any) -> str:
    """Returns means over seeds, with intervals except of sets of few layouts."""
    few = {"st", "sy", "stsy"}
    texts = [
        cells([seeds.mean()])
        if name in few
        else tables.mean_text(seeds.to_numpy(), ".1f", high=100)
        for name, seeds in percent.items()
    ]
    return " | ".join(texts)


def one_decimal(value: float) -> str:
    return f"{value:.1f}".replace("-", "−")


def mean_interval(values: Any) -> list[str]:
    """Returns the mean, and the ends of its 95 % interval of Student's t."""
    mean = np.mean(values)
    ends = stats.t.interval(0.95, len(values) - 1, mean, stats.sem(values))
    return list(map(one_decimal, (mean, *ends)))


def percent_of(file: str, policy: str | None = None) -> Any:
    """Returns the percentages that `agents.evaluate` wrote to a CSV file."""
    table = pd.read_csv(RESULTS / file)
    if policy:
        table = table.query("policy == @policy")
    table = table.set_index("task_set")
    return (100 * table["solved"] / table["tasks"])[list(ALL_SETS)]


def first_pushes(file: str, policy: str) -> Any:
    """Returns how many first pushes in {P} went to the exit, and how many away from it."""
    rows = pd.read_csv(RESULTS / file).query("policy == @policy and part == 'first-push-p'")
    return rows.set_index("level").loc[["to the exit", "away from it"], "tasks"]


def knowledge(pushes: Any, percent: Any) -> str:
    """Returns the share of right first pushes, with its interval, and the percent solved."""
    shares = [pushes.iloc[0] / pushes.sum(), *wilson_interval(pushes.iloc[0], pushes.sum())]
    right, low, high = (100 * share for share in shares)
    return f"{right:.1f} [{low:.0f}, {high:.0f}] | {cells(percent[['p', 'pst', 'psy', 'pstsy']])}"


def agents_that_know_colors() -> list[str]:
    """Returns the rows of their table, and what the development tasks showed."""
    pushes = first_pushes("memory/profile.csv", "best-pstsy")
    known = knowledge(pushes, percent_of("leaderboard/confirmation.csv"))
    rows = [f"| best-pstsy, without colours | {known} |"]
    right, solved = {}, {}
    for policy in rows_of("colors", "first_pushes")["policy"].unique():
        pushes = first_pushes("colors/first_pushes.csv", policy)
        if policy == "colors-p+psy+pstsy":  # the first tasks chose it
            pushes -= first_pushes("colors/development.csv", policy)
        right[policy] = 100 * pushes.iloc[0] / pushes.sum()
        solved[policy] = percent_of("colors/confirmation.csv", policy)
        if not policy.startswith(("seed 2", "seed 300", "seed 301")):
            rows.append(f"{policy} | {knowledge(pushes, solved[policy])} |")
    five = [f"seed {number}" for number in range(330, 335)]
    mean = tables.mean_text(np.array([right[policy] for policy in five]), ".1f", high=100)
    percent = pd.DataFrame(solved)[five].mean(axis=1)[["p", "pst", "psy", "pstsy"]]
    rows.append(f"| mean of these five | {mean} | {cells(percent)} |")
    kinds = rows_of("colors", "kinds").set_index(["level", "policy"])
    shares = (100 * kinds["solved"] / kinds["tasks"]).map("{:.1f}".format)
    towards, sideways = (shares[f"{direction}, along"] for direction in ("towards", "sideways"))
    slower = "seed 332, slower decay"
    rows += [
        f"332 and 333 solve {towards['seed 332']} % each",
        f"332 solves {towards[slower]} % of these tasks, but {sideways[slower]} instead of "
        f"{sideways['seed 332']} %",
    ]
    assert towards["seed 332"] == towards["seed 333"]
    gains = [
        right[policy] - right[policy.removesuffix(", fine-tuned")]
        for policy in right
        if policy.endswith(", fine-tuned")
    ]
    assert len(gains) == 6
    assert sum(round(gain) in range(6, 11) for gain in gains) == 4
    mean, low, high = mean_interval(gains)
    rows.append(f"on average of six agents by {mean} points [{low}, {high}]: four gain 6 to 10")
    before, chosen, control = (
        first_pushes("colors/development.csv", f"seed 300, {name}")
        for name in ("last iteration", "fine-tuned", "fine-tuned as a control")
    )
    before, chosen, control = (100 * x.iloc[0] / x.sum() for x in (before, chosen, control))
    rows.append(f"from {before:.1f} to {chosen:.1f} %")
    rows.append(f"without limit and discount, it ends at {control:.1f} %")
    return rows


def first_grasps() -> list[str]:
    """Returns the ranges of right first grasps, and of success after right and wrong ones."""
    rows = rows_of("first_grasps", "profile")
    counts = rows.pivot_table(index=["policy", "part"], columns="level", values=["tasks", "solved"])
    tasks, solved = counts["tasks"], counts["solved"]
    shares = [tasks["the tool"] / tasks.sum(axis=1)]
    shares += [solved[level] / tasks[level] for level in ("the tool", "another object")]
    low_high = [(100 * share.min(), 100 * share.max()) for share in shares]
    texts = ("{:.0f} to {:.0f} %", "{:.0f} to {:.0f} % of the tasks", "{:.0f} to {:.0f} %")
    return [text.format(*ends) for text, ends in zip(texts, low_high, strict=True)]


def memory() -> list[str]:
    """Returns the table of success in {P, Sy} by memory, and what training without it costs."""
    grasps = pd.concat([rows_of("memory", "profile"), rows_of("ingredients", "first_grasps")])
    grasps = grasps.query("part == 'first-grasp-psy'")
    percent = grasps.assign(percent=100 * grasps["solved"] / grasps["tasks"])
    percent = percent.pivot_table(index="policy", columns="level", values="percent")
    seeds = range(10, 18)
    trained = {"eight seeds": "best", "eight seeds, `recurrent=False`": "no-memory"}
    policies = {  # with and without `repeat_penalty`
        "`best-pstsy`": (["best-pstsy"], ["plain"]),
        "the same, GRU reset before every step": (["no-memory"], ["no-memory-plain"]),
        **{
            text: tuple([f"{name}-seed{seed}{end}" for seed in seeds] for end in ("", "-repeats"))
            for text, name in trained.items()
        },
    }
    levels = ["the tool", "another object"]
    rows = []
    for text, pair in policies.items():
        found = np.concatenate([percent.loc[names, levels].mean() for names in pair])
        rows.append(f"| {text} | {cells(found)} |")
    solved = percent_solved("ingredients")["sy"].eq(100).groupby("algorithm").sum()
    assert solved[["no-memory", "best"]].tolist() == [8, 6]
    rows.append("Without memory all eight solve {Sy}, with it six.")
    return [*rows, *(cost_of("no-memory", name) for name in ("p", "psy"))]


@functools.cache
def ingredients(task_set: str) -> tuple[dict[str, int], dict[str, str], dict[str, str]]:
    """Returns seeds, success and the difference from `best` with its interval, by arm."""
    tested = tables.reported(rows_of("ingredients", "results"))
    arms = tables.by_set(tested)[task_set].groupby("algorithm")
    found = tables.differences(tested).set_index(["task_set", "algorithm"]).loc[task_set]
    differences = {
        arm: "{} [{}, {}]".format(*map(one_decimal, ends))
        for arm, *ends in found[["difference", "low", "high"]].itertuples()
    }
    return arms.size().to_dict(), arms.mean().map(one_decimal).to_dict(), differences


def without_an_ingredient() -> list[str]:
    """Returns the rows of the table of ingredients."""
    names = {
        "PPO settings, the paper's instead": "paper-ppo",
        "replay": "no-replay",
        "[predicting motion](motion.md)": "no-motion",
        "`effects`, RND instead": "rnd",
        "[memory](profiles.md#memory)": "no-memory",
        "turning the board": "unturned",
        "blindness to colour": "known-colors",
    }
    seeds, percent, differences = ingredients("p")
    assert {"best", *names.values()} == set(seeds)
    rows = [
        f"| {text} | {seeds[arm]} | {percent[arm]} | {differences[arm]} |"
        for text, arm in names.items()
    ]
    return [f"eight seeds of `best` solve {percent['best']} % of {{P}}.", *rows]


def cost_of(arm: str, task_set: str) -> str:
    """Returns success without an ingredient and with it, and the difference with its interval."""
    _, percent, differences = ingredients(task_set)
    percents = f"{percent[arm]} instead of {percent['best']} % of {label(task_set)}"
    return f"{percents} (difference {differences[arm]}"


def steps_of_replay() -> str:
    """Returns the steps taken without replay and with it, and how far `best` is by the fewer."""
    curves = rows_of("ingredients", "curves")
    steps = curves.groupby(["algorithm", "seed"])["transitions"].max().groupby("algorithm").mean()
    evaluated = rows_of("ingredients", "results").query("purpose == 'validation'")
    evaluated = evaluated.merge(curves, on=["algorithm", "seed", "iteration"])
    known = evaluated.query("algorithm == 'best' and task_set == 'p'")
    known = known[known["transitions"] <= steps["no-replay"]]
    known = known.sort_values("transitions").groupby("seed").last()
    success = 100 * (known["solved"] / known["tasks"]).mean()
    counts = (steps["no-replay"], steps["best"], known["transitions"].mean())
    few, many, reached = (f"{count / 1e6:.1f}" for count in counts)
    return f"{few} instead of {many} million steps; after {reached}, `best` solves {success:.1f} %"


def predicted_motion() -> list[str]:
    """Returns the rows of the table of `motion.md`, and the interval of their difference."""
    found = [percent_solved(name)["p"] for name in ("exp2_without_motion", "exp2_motion")]
    rows = [
        f"| {{P}}, {name} | {cells([*seeds, seeds.mean()])} |"
        for name, seeds in zip(("without", "with"), found, strict=True)
    ]
    test: Any = stats.ttest_ind(*reversed(found), equal_var=False)
    ends = (found[1].mean() - found[0].mean(), *test.confidence_interval())
    difference, low, high = map(one_decimal, ends)
    rows.append(
        f"The difference, {difference} points [{low}, {high}], may be chance (Welch's t-test, "
        f"p = {test.pvalue:.2f})"
    )
    gain = ingredients("p")[2]["no-motion"].split()[0].lstrip("−")
    rows.append(f"After 8 million steps, [it gains {gain} points]")
    return rows


def avoided_repeats() -> list[str]:
    """Returns the rows of the table of `repeats.md`, and the gains within policies."""
    found = rows_of("repeats", "results").assign(avoids=lambda x: x["repeat_penalty"] > 0)
    found["percent"] = 100 * found["solved"] / found["tasks"]
    percent = found.pivot_table(index=["task_set", "avoids"], columns="seed", values="percent")
    rows = []
    for (name, avoids), seeds in percent.loc[["p", "pstsy"]].iterrows():
        text = "with" if avoids else "without"
        rows.append(f"| {label(name)}, {text} | {cells([*seeds, seeds.mean()])} |")
    gains = [percent.loc[(name, True)] - percent.loc[(name, False)] for name in ("p", "pstsy")]
    (mean, low, high), (mean_all, low_all, high_all) = map(mean_interval, gains)
    rows.append(
        f"gains {mean} points on {{P}} (95 % interval over five policies {low} to {high}) and "
        f"{mean_all} on {{P, St, Sy}} ({low_all} to {high_all})"
    )
    return rows


def steps_with_colors(*policies: str) -> int:
    """Returns the environment steps of trainings in which agents learned colours."""
    curves = rows_of("colors", "curves").groupby("policy")["transitions"]
    return curves.max().loc[list(policies)].sum()


def sought_bonus() -> str:
    """Returns how the bonus per step and the entropy change in the published code's PPO."""
    found = rows_of("exp1_code", "bonus").pivot(index="seed", columns="iteration")
    low, high = found.min(), found.max()
    bonus = [
        f"{low['intrinsic_reward', i]:,.0f}–{high['intrinsic_reward', i]:,.0f}" for i in (1, 250)
    ]
    entropy = (
        f"{low['entropy', 1]:.1f}–{high['entropy', 1]:.1f} to at most {high['entropy', 250]:.2f}"
    )
    return f"rises from {bonus[0]} to {bonus[1]}, while entropy falls from {entropy} nats"


def random_actions() -> list[float]:
    """Returns the percentages that random actions solve."""
    scores = json.loads((RESULTS / "leaderboard" / "random.json").read_text())
    return [score["percent"] for score in scores["sets"]]


def on_readme() -> list[str]:
    """Returns the rows of Table 2."""
    sets = list(ALL_SETS[1:])
    paper = percent_solved("exp2_paper").droplevel(1).loc["ppo+icm", sets]
    published = tables.PAPER_SUCCESS["PPO + ICM, paper"][0]
    return [
        f"| PPO + ICM, paper | {cells(published)} |",
        f"| preset `paper` | {cells(paper)} |",
        f"| preset `best` | {means(percent_solved('exp2_best')[sets])} |",
    ]


def on_the_leaderboard() -> list[str]:
    """Returns the rows of `protocol.md`."""
    published = [
        f"{cells(percent)} | ≤ 25,600,000 |" for percent, _ in tables.PAPER_SUCCESS.values()
    ]
    paper = percent_solved("exp2_paper").droplevel(1).loc["ppo+icm", list(ALL_SETS)]
    repeats = rows_of("repeats", "results").query("seed == 0 and repeat_penalty > 0")
    repeats = repeats.set_index("task_set")
    shipped = (100 * repeats["solved"] / repeats["tasks"])[list(ALL_SETS)]
    fast = percent_solved("fast_base").drop(columns=tables.MEAN).droplevel(0)
    rows = [
        (paper, steps("exp2_paper", "ppo+icm")[0]),
        (shipped, steps("exp2_motion")[0]),
        (fast.mean(), steps("fast_base").mean()),
        (fast.loc[7], steps("fast_base")[7]),
        (percent_solved("exp2_best").drop(columns=tables.MEAN).mean(), steps("exp2_best").mean()),
    ]
    colors = {
        "p+p+pst+pstsy": ("seed 330, fine-tuned", "seed 330"),
        "p+psy+pstsy": ("colors-p+psy+pstsy",),
    }
    return [
        *published,
        bound_of_plans(),
        *(f"| {cells(percent)} | {taken:,.0f} |" for percent, taken in rows),
        *(
            f"| {sets} | {cells(percent_of('colors/test.csv', policies[0]))} | "
            f"{steps_with_colors(*policies):,.0f} |"
            for sets, policies in colors.items()
        ),
        f"| {cells(percent_of('leaderboard/icm-base.csv'))} |",
        f"| {cells(random_actions())} |",
    ]


def bound_of_plans() -> str:
    """Returns the row of shortest plans; colours change none."""
    like = {"stsy": "{Sy}", "pst": "{P}", "st": "base", "pstsy": "{P, Sy}"}
    solvable = (shortest_plans()[like.get(name, label(name))][1] for name in ALL_SETS)
    return f"| {' | '.join(text.removesuffix(' %').replace('.00', '') for text in solvable)} |"


def shortest_plans() -> dict[str, list[str]]:
    """Returns the solver's statistics: the cells of their row by the label of the set."""
    rows = (RESULTS / "leaderboard" / "plans.txt").read_text().splitlines()
    split = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows if "%" in row]
    return {first: rest for first, *rest in split}


def on_environment_md() -> list[str]:
    """Returns the rows of the table of task sets."""
    rows = []
    for name in ("{P}", "{P, Sy}"):
        _, solvable, mean, low, *_, high, longest = shortest_plans()[name]
        rows.append(
            f"| {name} | {solvable.replace('.00', '')} | {mean}; {low} to {high}; {longest} |"
        )
    return rows


def on_best_preset_md() -> list[str]:
    """Returns the seeds of `best`, and what its ingredients give."""
    table = percent_solved("exp2_best").droplevel(0).drop(columns=["base", tables.MEAN])
    return [
        *(f"| {seed} | {cells(row)} |" for seed, row in table.iterrows()),
        f"| mean | {cells(table.mean())} |",
        *without_an_ingredient(),
        steps_of_replay(),
    ]


def on_curiosities_md() -> list[str]:
    """Returns the rows of the table of curiosities, and by how much RND falls short."""
    tested = tables.reported(rows_of("exp2_curiosities", "results"))
    found = tables.differences(tested).query("task_set != @tables.MEAN")
    assert (found["p"] < 0.05).all()  # "exceeds the others wherever"
    rnd = found.set_index(["task_set", "algorithm"]).loc[("p", "ppo+rnd")]
    rnd = -rnd[["difference", "high", "low"]]
    percent = percent_solved("exp2_curiosities").drop(columns="base").groupby("algorithm")
    return [
        *(f"| `{name}` | {means(seeds)} |" for name, seeds in percent),
        "by {:.1f} points on {{P}} [{:.1f}, {:.1f}]".format(*rnd),
    ]


def on_paper_preset_md() -> list[str]:
    """Returns when seeds first solve base, and what the published code's bonus does."""
    never = rows_of("exp1_code", "curves").groupby("seed")[["episodes", "validation_success"]].max()
    assert never.to_numpy().tolist() == [[256_000, 0]] * 5
    solved = rows_of("exp1", "curves").query("validation_success == 1")
    first = solved.pivot_table("episodes", "seed", "algorithm", "min").reindex(range(5))
    first = first.map("{:,.0f}".format).replace("nan", "–")
    return [
        sought_bonus(),
        *(f"| {seed} | {icm} | {ppo} |" for seed, (ppo, icm) in first.iterrows()),
    ]


def on_profiles_md() -> list[str]:
    """Returns what agents know of colours, and what memory gives."""
    return [*agents_that_know_colors(), *first_grasps(), *memory()]


def on_table_2_md() -> list[str]:
    """Returns the rows of the agents of preset `paper`."""
    ours = percent_solved("exp2_paper").droplevel(1).loc[["ppo+icm", "ppo"]]
    bonus = percent_solved("exp2_code").loc["ppo+bonus", 0]
    taken = steps("exp2_code")[0] / 1e6
    return [
        *(f"| {label(name)} | {cells(ours[name])} |" for name in ALL_SETS[1:]),
        f"after {taken:.1f} million steps, solves {bonus['sy']:.1f} % of {{Sy}} and "
        f"{bonus['pstsy']:.1f} % of {{P, St, Sy}}",
    ]


@pytest.mark.parametrize(
    ("page", "statements"),
    [
        ("README.md", on_readme),
        ("trap_tube_jax/environment.md", on_environment_md),
        ("trap_tube_jax/protocol.md", on_the_leaderboard),
        ("benchmarks/results/best_preset.md", on_best_preset_md),
        ("benchmarks/results/curiosities.md", on_curiosities_md),
        ("benchmarks/results/motion.md", predicted_motion),
        ("benchmarks/results/paper_preset.md", on_paper_preset_md),
        ("benchmarks/results/profiles.md", on_profiles_md),
        ("benchmarks/results/repeats.md", avoided_repeats),
        ("benchmarks/results/table_2.md", on_table_2_md),
    ],
)
def test_a_page_states_what_the_records_hold(page, statements):
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    assert [] == [statement for statement in statements() if statement not in text]

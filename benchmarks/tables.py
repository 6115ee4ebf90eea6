"""The tables of benchmark records, as Markdown for pages."""

from agents.experiments.records import Record
from agents.runs.table import Table, number
from benchmarks import scaling, scaling_model

FULL = 4096  # environments that fill a core; tables leave smaller batches out


def speeds(*records: Record) -> str:
    """Million steps per second of each subject: a row for each record and batch size.

    Args:
      records: of `benchmarks.env_throughput`, or of `benchmarks.peers`.
    """
    names = dict.fromkeys(result["name"] for record in records for result in record["results"])
    rows: dict[str, dict[str, float]] = {}
    for record in records:
        for result in record["results"]:
            if result["num_envs"] >= FULL:
                cells = rows.setdefault(_measured(record, result), {})
                cells[result["name"]] = result["steps_per_s"] / 1e6
    cells = [
        (row, *(number(found.get(name), ".1f") for name in names)) for row, found in rows.items()
    ]
    return Table("", ("M steps/s", *names), tuple(cells)).to_markdown()


def speed_up(record: Record) -> str:
    """The model of several devices, from a record of `benchmarks.scaling_model`."""
    return scaling_model.speed_up_table(record["model"])


def points(record: Record) -> str:
    """Speed and peak memory, from a record of `benchmarks.scaling`: a table for each kind."""
    parts = []
    for kind, title in scaling.TITLES.items():
        found = [scaling.Point(**each) for each in record["results"] if each["kind"] == kind]
        sizes = dict.fromkeys(f"{point.size:,}" for point in found)
        rows = []
        for env in dict.fromkeys(point.env for point in found):
            own = [point for point in found if point.env == env]
            memory = (f"{point.peak_bytes / 2**30:.2f}" for point in own)
            rows.append((f"{env}, per second", *(f"{point.steps_per_s:,.0f}" for point in own)))
            rows.append((f"{env}, peak memory, GiB", *memory))
        table = Table(title, (kind, *sizes), tuple(rows))
        parts.append(f"**{table.title}**\n\n{table.to_markdown()}")
    return "\n\n".join(parts)


def _measured(record: Record, result: Record) -> str:
    """What the row of a result is called."""
    devices, (machine,) = result["devices"], record["machines"]
    which = f"{devices} device{'s' * (devices != 1)}, {result['num_envs']:,} environments"
    return f"{which}, commit `{machine['commit'][:7]}`"

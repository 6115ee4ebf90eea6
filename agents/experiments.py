"""The named grids, such as exp1 and best: python -m agents.experiments NAME --help."""

import sys
from collections.abc import Sequence

from agents import sweep
from agents.sweeps.grids import GRIDS
from trap_tube_jax.checks import did_you_mean
from trap_tube_jax.interruptions import run_command

PROGRAM = "python -m agents.experiments"


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ("",)
    if name not in GRIDS:
        asked = name in ("-h", "--help")
        lines = [f"usage: {PROGRAM} NAME [options]", "", "names:"]
        lines += [f"  {known:<13}{grid.about}" for known, grid in GRIDS.items()]
        lines += ["", f"{PROGRAM} NAME --help lists the options."]
        if name and not asked:
            lines.append(f"error: unknown name {name!r}{did_you_mean(name, GRIDS)}")
        print("\n".join(lines), file=sys.stdout if asked else sys.stderr)
        raise SystemExit(0 if asked else 2)
    sweep.main(rest, f"{PROGRAM} {name}", name, GRIDS[name])


if __name__ == "__main__":
    run_command(main)

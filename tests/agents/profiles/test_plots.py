"""Figures of profiles made by hand."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from agents.profiles import plots


def test_success_is_drawn_from_0_to_100_with_a_colour_for_each_policy(tmp_path, monkeypatch):
    groups = [
        {"policy": policy, "part": part, "level": "0.5", "tasks": 4, "solved": 4, "plan": 9.0}
        for part in ("perceptual", "plan-length", "both")
        for policy in "ab"
    ]
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    plots.save_success(pd.DataFrame(groups), tmp_path / "x.png")
    shown = drawn[0].axes
    assert all(axis.get_ylim() == (0, 100) for axis in shown)
    assert drawn[0].get_supylabel()
    colours = [[lines.lines[0].get_color() for lines in axis.containers] for axis in shown]
    assert colours == [list(plots.COLORS[:2])] * 3
    bar = shown[0].containers[0].lines[2][0].get_segments()[0][:, 1]
    np.testing.assert_allclose(bar, [51.01, 100], atol=0.1)  # Wilson, 4 of 4

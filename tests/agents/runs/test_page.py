"""The page of a run in a browser: buttons, arrow keys, and screens of two sizes."""

import html
import json
import re
import shutil
import subprocess

import pytest

from agents.runs import report
from agents.runs.evaluator import Evaluator
from agents.runs.folder import RunFolder
from agents.runs.metrics import append_rows
from agents.runs.run import Run
from helpers.small_runs import small_config
from helpers.tiny_policy import random_params
from trap_tube_jax.scoring.tasks import ALL_SETS

pytestmark = pytest.mark.slow
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
CONFIG = small_config()
METRICS = {
    "iteration": 1, "episodes": 8, "transitions": 48, "seconds": 1.0, "validation_success": 0.5
}  # fmt: skip
FRAMES = """<!doctype html><meta charset="utf-8">
<iframe id="laptop" width="1280" height="900" srcdoc="{page}"></iframe>
<iframe id="phone" width="390" height="844" srcdoc="{page}"></iframe>
<pre id="found"></pre>
<script>
const page = id => document.getElementById(id).contentWindow;
const part = id => page("laptop").document.getElementById(id);
const press = key => page("laptop").document.activeElement.dispatchEvent(
  new KeyboardEvent("keydown", {{ key, bubbles: true, cancelable: true }}));
const found = {{ steps: [] }};
const note = () => found.steps.push(Number(part("step").value));
window.onload = () => {{
  found.longest = Number(part("step").max);
  for (const id of ["next", "next", "back"]) {{ part(id).focus(); part(id).click(); note(); }}
  for (const id of ["next", "step", "episode", "play"]) {{
    part(id).focus(); press("ArrowRight"); note();
  }}
  press("ArrowLeft"); note();
  found.caption = part("caption").textContent;
  found.bottom = part("play").getBoundingClientRect().bottom;
  found.overflow = ["laptop", "phone"].map(id => {{
    const root = page(id).document.documentElement;
    return Math.max(0, root.scrollWidth - root.clientWidth);
  }});
  part("play").click();
  found.during = part("play").textContent;
  setTimeout(() => {{
    note();
    found.after = part("play").textContent;
    document.getElementById("found").textContent = JSON.stringify(found);
  }}, 60000);
}};
</script>
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Opens a page in a browser: clicks, keys and a minute of play, in virtual time."""
    if BROWSER is None:
        pytest.skip("needs Chromium")
    folder = RunFolder(tmp_path_factory.mktemp("page") / "mine")
    folder.path.mkdir()
    append_rows(folder.metrics, [METRICS])
    evaluator = Evaluator.of_sets(CONFIG, tuple(ALL_SETS), 2)
    report.write(folder, Run(CONFIG), evaluator.suite, evaluator(random_params(CONFIG)))
    frames = folder.path / "frames.html"
    frames.write_text(FRAMES.format(page=html.escape(folder.page.read_text())), encoding="utf-8")
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=90000")
    profile = f"--user-data-dir={folder.path / 'profile'}"
    command = [BROWSER, *options, profile, "--dump-dom", frames.as_uri()]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    match = re.search(r'<pre id="found">(.+?)</pre>', text)
    assert match is not None
    return json.loads(html.unescape(match[1]))


def test_buttons_and_arrow_keys_step_whatever_has_the_focus(found):
    assert found["steps"][:-1] == [1, 2, 1, 2, 3, 4, 5, 4]
    assert found["caption"].startswith("The agent: step 4 of ")


def test_play_runs_to_the_end_and_stops(found):
    assert found["during"] == "Pause"
    assert found["steps"][-1] == found["longest"] > 5
    assert found["after"] == "Play"


def test_the_page_fits_a_laptop_and_a_phone(found):
    assert found["bottom"] < 900
    assert found["overflow"] == [0, 0]

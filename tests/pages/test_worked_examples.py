"""The implant, engine and objective of docs/extending.md, added to a copy of the package."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from paths import DOCS, ROOT

PAGE = (DOCS / "extending.md").read_text()
NEW = re.findall(r"^`(mirror_ppl/\S+)` \(new\):\n\n```python\n(.*?)```", PAGE, re.M | re.S)
DIFFS = re.findall(r"^```diff\n(.*?)```", PAGE, re.M | re.S)
USE = """
import mirror_ppl
from mirror_ppl.communication import RoundSoFar

rounds = mirror_ppl.load_recordings().select_people(["person-01"])
few = {"train_rounds": 1, "explore": 0, "draws": 8}
weighted = mirror_ppl.infer(rounds, engine="likelihood-weighting", **few)
assert weighted.person().summary["engine"] == "likelihood-weighting"
fit = mirror_ppl.infer(rounds, human="inclined", **few)
assert "inclination" in fit.person().implants.index
observation = {name: value[0, 25, :1] for name, value in rounds.observation().items()}
told = {name: value[0, 25, :0] for name, value in rounds.told.items()}
past = RoundSoFar(observation, rounds.actions[0, 25, :0], told)
decision = mirror_ppl.Communicator(fit, planner="mirror-agree").plan(past)
assert 0 < decision.found.valued.utility[0].mean() < 1
print("used")
"""


def test_the_page_has_three_of_them():
    assert [name for name, _ in NEW] == [
        "mirror_ppl/inference/likelihood_weighting.py",
        "mirror_ppl/communication/agreement.py",
    ]
    assert len(DIFFS) == 3


@pytest.mark.slow
def test_they_can_be_added_and_used(tmp_path):
    shutil.copytree(ROOT / "mirror_ppl", tmp_path / "mirror_ppl")
    for name, content in NEW:
        (tmp_path / name).write_text(content)
    for diff in DIFFS:
        subprocess.run(
            ["git", "apply", "--unidiff-zero", "-"], input=diff, text=True, cwd=tmp_path, check=True
        )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", USE],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "used", done.stderr

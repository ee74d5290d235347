"""What is shown is true: commands, links, tables and numbers of README and pages."""

import re
import shlex
from dataclasses import asdict

import pyro
import pytest
import tyro
from paths import ROOT
from pyro import poutine
from shown_pages import PAGES, blocks, commands, imported, page, table_of

from mirror_ppl.commands import COMMANDS, assist, evaluate
from mirror_ppl.communication.planners import PlannerOptions
from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.assistance import COMMUNICATORS
from mirror_ppl.inference.adaptive_importance import PRUNING_DRAWS, ImportanceOptions
from mirror_ppl.inference.sampler import MANY_MOMENTS, MERGING_DRAWS
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import model_names
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import populations_of
from mirror_ppl.training import views as training_views
from mirror_ppl.training.self_model_options import SelfModelOptions


def name_of(path):
    return path.name


def anchors(text):
    """Anchors of the headings, as they are made on the usual hosts of repositories."""
    without_code = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", without_code, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings
    }


def make_targets():
    written = page("Makefile") + page("benchmarks/highway.mk")
    return set(re.findall(r"^([a-z]+):", written, re.MULTILINE))


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


# --- commands ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("where", "line"), commands())
def test_every_command_is_real(where, line):
    words = shlex.split(line)
    if words[0] == "mirror-ppl":
        words[:2] = "python", "-m", f"mirror_ppl.{words[1].replace('-', '_')}"
    if words[0] == "make":
        assert set(words[1:]) <= make_targets()
        return
    assert words[:2] == ["python", "-m"], f"{where} shows {line}"
    module = imported(words[2])
    assert words[2].removeprefix("mirror_ppl.") in COMMANDS
    options = vars(tyro.cli(module.Options, args=words[3:]))
    # Whom to assist is told by the posterior, and whom to fit by recordings, unless it is said.
    if module is evaluate:
        assert evaluate._cells(evaluate.Options(**options))
        return
    domain = get_domain(options.get("domain") or "driving")
    assert options.get("setting") in (*domain.settings, None)
    assert options.get("population") in (*populations_of(domain.name), None)
    for option in ("card", "human_model"):
        path = str(options.get(option) or "").partition(":")[0]
        assert not path or path in model_names() or (ROOT / path).is_file()


def test_commands_in_the_text_are_real():
    for path in PAGES:
        for module in re.findall(r"python -m ([\w.]+)", path.read_text()):
            imported(module)
        assert set(re.findall(r"`make ([a-z]+)", path.read_text())) <= make_targets()


def test_the_readme_begins_with_the_picture_and_the_two_commands():
    first = page("README.md").split("## ")[0]
    assert "docs/images/sight.png" in first
    assert blocks(first, "console") == ["make demo\nmake test\n"]


# --- links ------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_links_lead_somewhere(path):
    text = re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        found = path.parent / file if file else path
        assert found.exists(), f"{path.name} links to {target}"
        assert not anchor or anchor in anchors(found.read_text()), f"{path.name}: {target}"


def test_every_page_is_listed_in_the_readme():
    for path in (ROOT / "docs").glob("*.md"):
        assert f"docs/{path.name}" in page("README.md")


# --- tables and numbers -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "heading", "options"),
    [
        ("docs/self_model.md", "Setting", SelfModelOptions()),
        ("docs/human_model.md", "Setting of `svi` (`SVIOptions`)", SVIOptions()),
        (
            "docs/human_model.md",
            "Setting of `importance` (`ImportanceOptions`)",
            ImportanceOptions(),
        ),
    ],
)
def test_tables_of_settings_are_the_defaults(name, heading, options):
    shown = {row[0].strip("`"): float(row[1]) for row in table_of(page(name), heading)}
    settings = asdict(options)
    settings.pop("kinds", None)  # told by the table of views
    assert shown == {key: pytest.approx(float(value)) for key, value in settings.items()}


def test_settings_of_other_worlds_are_those_of_their_records():
    """The table holds each setting of a self-model that differs from driving's."""
    rows = table_of(page("docs/self_model.md"), "Setting elsewhere")
    ours = asdict(SelfModelOptions())
    for column, world in enumerate(("search_rescue", "bomb_defusal", "highway"), start=1):
        settings = asdict(SelfModelOptions.of(world))
        shown = {row[0].strip("`"): float(row[column]) for row in rows}
        assert shown == {name: pytest.approx(float(settings[name])) for name in shown}
        differ = {name for name in ours if ours[name] != settings[name]}
        assert differ - {"kinds"} <= set(shown)  # of views there is a table of its own


def test_names_of_the_glossary_are_in_the_code():
    source = "".join(path.read_text() for path in (ROOT / "mirror_ppl").rglob("*.py"))
    rows = re.findall(r"^\|.*\|.*\|.*\|(.*)\|$", page("docs/glossary.md"), re.MULTILINE)
    columns = [row for row in rows if "`" in row]
    names = re.findall(r"`-*([\w.-]+?)[.]*`", " ".join(columns))
    assert len(columns) > 50 and len(names) > len(columns)
    for name in names:
        for part in name.removeprefix("fit.").replace("-", "_").split("."):
            assert part in source, name


def test_options_and_communicators_of_assist_are_as_on_the_page():
    text, options = page("docs/communicator.md"), assist.Options()
    shown = {row[0].strip("`-").replace("-", "_"): row[1] for row in table_of(text, "Option")}
    assert shown.pop("communicator") == "all of them" and options.communicator == ()
    assert shown.pop("plan_anyway") == "off" and options.plan_anyway is False
    domains = ("horizon", "enumerate_above", "patience", "min_standard_errors", "discount", "hears")
    for name in domains:
        assert shown.pop(name) == "the domain's" and getattr(options, name) is None
    assert shown == {name: str(getattr(options, name)) for name in shown}
    first = " ".join(row[0] for row in table_of(text, "Communicator"))
    assert tuple(re.findall(r"`([\w-]+)`", first)) == COMMUNICATORS


def test_margins_of_the_worlds_are_on_the_page_and_in_the_help_of_assist():
    worlds = ("highway", "driving", "search_rescue", "bomb_defusal")
    margins = [PlannerOptions.of(world).min_standard_errors for world in worlds]
    assert margins == [2, 1, 1, 0]
    shown = {row[0]: row[2] for row in table_of(page("docs/communicator.md"), "Option")}
    words = "2 in highway driving, 1 in driving and in search and rescue, 0 in bomb defusal"
    assert words in shown["`--min-standard-errors`"]
    source = " ".join((ROOT / "mirror_ppl/commands/assist.py").read_text().split())
    assert "2 in highway, 1 in driving and search_rescue and 0 in bomb_defusal" in source


def test_views_of_training_have_the_shares_of_the_page():
    rows = {row[0]: row for row in table_of(page("docs/self_model.md"), "View")}
    assert SelfModelOptions().kinds == training_views.KIND_PROBABILITIES
    assert "`SelfModelOptions.kinds`" in page("docs/self_model.md")
    assert {name: row[1] for name, row in rows.items()} == {
        kind: f"{share:.0%}"
        for kind, share in zip(training_views.KINDS, training_views.KIND_PROBABILITIES, strict=True)
    }
    told = [f"{training_views.ALIKE_PROBABILITY:.0%}", f"{training_views.TOLD_PROBABILITY:.0%}"]
    assert re.findall(r"in (\d+%)", rows["sight"][2]) == told
    share = f"in {training_views.ASSUMPTION_PROBABILITY:.0%}"
    assert page("docs/self_model.md").lower().count(share) == 2  # once for each assumption


def test_priors_are_as_on_the_page(self_model):
    human = HumanModel(self_model)
    with pyro.plate("person", 1, dim=-2):
        sites = poutine.trace(human.prior).get_trace().nodes
    spread = sites["consistency"]["fn"]
    rows = {
        row[0].split()[0].strip("`"): row[1]
        for row in table_of(page("docs/human_model.md"), "Site")
    }
    assert rows["sight_*"] == f"uniform over {len(human.domain.reach_bins)} bins"
    assert rows["consistency"] == f"LogNormal(log *m*, {spread.scale.item():g})"
    assert spread.loc.exp().item() == pytest.approx(human.domain.record.consistency)
    lapse = sites["lapse"]["fn"]
    assert (
        rows["lapse"] == f"Beta({lapse.concentration1.item():g}, {lapse.concentration0.item():g})"
    )
    assert rows["residual_in"] == "Normal(0, 48^-1/2), 49 x 8"
    assert sites["residual_in"]["fn"].event_shape == (49, 8)
    assert sites["residual_out"]["fn"].event_shape == (9, 2)
    scale = sites["residual_out"]["fn"].base_dist.scale.max().item()
    assert rows["residual_out"] == f"Normal(0, {scale:.1f}), 9 x 2"


def test_approximations_have_the_tolerances_of_the_page():
    text = page("docs/human_model.md")
    assert f"more than {Screening().margin:.0f} nats" in text
    assert f"plus {Screening().early:.0f} divided by the number of rounds" in text
    assert f"best of {Screening().policies} prior policies" in text
    assert f"under each of {Screening().merge_policies} of those policies" in text
    assert f"a grid of {Screening().resolution} nats" in text
    assert f"the same at {SVIOptions().prune_margin:.0f} nats" in text
    assert SVIOptions().prune_margin == ImportanceOptions().prune_margin
    assert f"under {PRUNING_DRAWS} draws of the prior" in text
    assert f"if {MANY_MOMENTS:,} or more are left" in text
    assert f"the same under {MERGING_DRAWS} draws by the weights of that stage" in text
    assert f"on a grid of {ImportanceOptions().resolution} nats" in text


def test_quality_of_the_self_model_is_that_of_the_card():
    _, card = load_self_model(shipped_weights("driving"))
    part = page("docs/self_model.md").split("<!-- numbers: self-model -->")[1]
    shown = {row[0].replace(" ", "_"): float(row[1]) for row in table_of(part, "Measure")}
    assert shown == {
        name: pytest.approx(value, abs=6e-4) for name, value in card["quality"].items()
    }


def test_quality_of_the_highway_s_self_model_is_that_of_the_card():
    _, card = load_self_model(shipped_weights("highway"))
    rows = table_of(page("docs/highway.md"), "View")
    quality, views = card["quality"], ("full", "clear", "fog", "ahead only")
    assert [row[1:] for row in rows] == [
        [
            f"{quality[f'return_{view}']:.1f}",
            f"{quality[f'share_{view}']:.1%}",
            f"{quality[f'agreement_{view}']:.1%}" if f"agreement_{view}" in quality else "",
        ]
        for view in views
    ]

"""What is shown is true: Python, the worked example and common mistakes of README and pages."""

import re
import shlex
from collections import defaultdict

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_course import gone_through
from paths import ROOT
from pyro import poutine
from pyro.infer import TraceEnum_ELBO, config_enumerate
from shown_pages import blocks, commands, imported, page, table_of

from mirror_ppl import console
from mirror_ppl.data import load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.inference.svi import continuous_guide
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights

EXAMPLE = "docs/examples/late_reactions.py:LatePerson"


def run_command(line, *further):
    module = imported(shlex.split(line)[2])
    args = [*shlex.split(line)[3:], *further]
    return console.run(module.Options, module.main, prog=module.PROGRAM, description="", args=args)


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


# --- python on the pages ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder in which a user has recorded two people and fitted them with the example."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "docs").symlink_to(ROOT / "docs")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        simulate = next(line for _, line in commands() if "simulate" in line and "runs/" in line)
        assert run_command(simulate, "--people", "2", "--rounds", "4") == 0
        example = next(line for _, line in commands() if EXAMPLE in line)
        small = ("--demos", "runs/people.nc", "--draws", "8", "--out", "runs/demo")
        assert run_command(example, *small) == 0
    return folder


def test_the_commands_of_the_readme_write_what_it_says(results):
    demo = results / "runs" / "demo"
    names = {path.name for path in demo.iterdir()}
    pictures = {"sight.png", "samples.png", "check.png", "identifiability.png"}
    assert names == pictures | {"posterior.nc", "summary.json"}
    assert all(f"`{name}`" in page("README.md").replace("runs/demo/", "") for name in names)


@pytest.mark.parametrize(
    "name",
    [
        "README.md",
        "docs/tour.md",
        "docs/people.md",
        "docs/self_model.md",
        "docs/human_model.md",
        "docs/fit_files.md",
        "docs/extending.md",
        "docs/trust.md",
        "docs/search_rescue.md",
        "docs/bomb_defusal.md",
    ],
)
def test_python_blocks_run(name, results, monkeypatch):
    # New files of the package are run by test_worked_examples.py.
    new = blocks("".join(re.split(r"^`\S+` \(new\):\n$", page(name), flags=re.M)[1:]), "python")
    shown = [block for block in blocks(page(name), "python") if block not in new]
    assert shown
    monkeypatch.chdir(results)
    exec("\n".join(shown), {"__name__": "page"})


def test_python_of_the_communicator_runs(results, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ("--demos", f"{results}/runs/people.nc", "--draws", "64")
    assert run_command("python -m mirror_ppl.fit", *small, "--out", "runs/demo") == 0
    capsys.readouterr()
    exec("\n".join(blocks(page("docs/communicator.md"), "python")), {"__name__": "page"})
    assert "p(switch)" in capsys.readouterr().out


def test_the_example_on_the_page_is_the_file():
    source = page("docs/examples/late_reactions.py")
    assert blocks(page("docs/extending.md"), "python")[0].strip() in source
    for name in ("distracted", "looks_away", "sight_in_cells"):
        source = page(f"docs/examples/{name}.py")
        assert any(block.strip() in source for block in blocks(page("docs/extending.md"), "python"))


def test_groups_and_variables_of_results_are_on_the_page(results):
    import arviz as az

    text = page("docs/fit_files.md")
    told = defaultdict(str)
    for row in _filled(table_of(text, "Group")):
        for group in re.findall(r"`(\w+)`", row[0]):
            told[group] += f"{row[1]} {row[2]}; "
    told["predictions_constant_data"] += told["constant_data"]
    data = az.from_netcdf(results / "runs" / "demo" / "posterior.nc")
    assert set(told) - set(data.groups()) == {"population", "newcomer"}  # of pooled people
    for group in data.groups():
        for name, variable in data[group].data_vars.items():
            known = "`sight_*`" if name.startswith("sight_") else f"`{name}`"
            known = "`truth_*`" if name.startswith("truth_") else known
            assert known in told.get(group, "") or name == "late", f"{group}: {name}"
            own = [
                d for d in variable.dims if d in ("person", "round", "test_round", "step", "time")
            ]
            assert all(dimension in told[group] for dimension in own), f"{group}: {name} {own}"


def _filled(rows):
    """Rows whose empty first cells mean: as above."""
    first = ""
    for row in rows:
        first = row[0].strip("| ") or first
        yield [first, *row[1:]]


# --- the worked example -----------------------------------------------------------------------


def test_the_example_has_one_late_a_person(results):
    import arviz as az

    data = az.from_netcdf(results / "runs" / "demo" / "posterior.nc")
    for group in ("posterior", "prior"):
        late = data[group]["late"]
        assert late.dims == ("chain", "draw", "person")
        assert late.sizes["person"] == 2
        assert ((late > 0) & (late < 1)).all()
        assert (late.std("draw") > 0).all()
    assert data.posterior.attrs["human_model"] == "LatePerson"


def test_late_gets_a_gradient_for_each_person(results, self_model):
    human = load_human_model(f"{ROOT}/{EXAMPLE}", self_model)
    check_contract(human)
    recordings = load_demonstrations(results / "runs" / "people.nc").select_rounds(slice(0, 3))
    compiled = compile(human, recordings, screening=Screening())
    with pyro.settings.context(module_local_params=True):
        guide = continuous_guide(compiled)
        model = config_enumerate(compiled.program, "parallel")
        TraceEnum_ELBO(max_plate_nesting=PLATES)(model, guide)().backward()
    gradients = {name: value.grad for name, value in guide.named_parameters()}
    for part in ("locs", "scales"):
        gradient = next(g for name, g in gradients.items() if name.startswith(f"{part}.late"))
        assert gradient.shape == (2, 1)
        assert (gradient.abs() > 1e-4).all()


def test_late_is_the_mixture_that_it_says(self_model):
    human = load_human_model(f"{ROOT}/{EXAMPLE}", self_model)
    own = torch.randn(2, 5, self_model.latent)

    def act(model, sites, belief):
        with poutine.condition(data=sites), pyro.plate("person", 2, dim=-2):
            return model.act(model.prior(), belief, model.action_values(belief)).exp()

    sites = known(human, 2, reach_bin=2)
    sites["residual_in"] = torch.randn(2, 1, 49, 8)
    sites["residual_out"] = torch.randn(2, 1, 9, 2)
    prompt = act(HumanModel(self_model), sites, own)
    late = torch.tensor([0.25, 0.75])[:, None]
    # Step after step: at the first there is no belief before.
    before = torch.cat([own[:, :1], own[:, :-1]], 1)
    mixed = act(human, sites | {"late": late}, torch.cat([own, before], -1))
    torch.testing.assert_close(mixed[:, 0], prompt[:, 0])
    share = late[..., None]
    expected = (1 - share) * prompt[:, 1:] + share * prompt[:, :-1]
    torch.testing.assert_close(mixed[:, 1:], expected)


def test_a_late_person_remembers_the_belief_of_one_step_before(self_model, results):
    human, prompt = load_human_model(f"{ROOT}/{EXAMPLE}", self_model), HumanModel(self_model)
    recordings = load_demonstrations(results / "runs" / "people.nc")
    rounds = recordings.shape[1] * recordings.num_people
    steps = recordings.shape[2]
    observation = {
        name: value.flatten(0, 1)[:, :steps] for name, value in recordings.observation().items()
    }
    told = {name: value.flatten(0, 1) for name, value in recordings.told.items()}
    actions = recordings.actions.flatten(0, 1)
    sites = {
        name: value[:1, 0].expand(rounds)
        for name, value in known(human, 1, reach_bin=2).items()
        if not value.is_floating_point()
    }
    own = gone_through(prompt, sites, observation, told, actions)
    now, before = gone_through(human, sites, observation, told, actions).chunk(2, -1)
    torch.testing.assert_close(now, own)
    torch.testing.assert_close(before[:, 1:], own[:, :-1])
    torch.testing.assert_close(before[:, 0], own[:, 0])


def known(human, people, reach_bin):
    """Values of the sites of the package's own model: sight to a bin, little else."""
    ones = torch.ones(people, 1)
    sites = {f"sight_{direction}": reach_bin * ones.long() for direction in human.domain.directions}
    return sites | {
        "assumes_clear": 0 * ones.long(),
        "assumes_closing": 0 * ones.long(),
        "consistency": 3.0 * ones,
        "lapse": 0.01 * ones,
        "residual_out": torch.zeros(people, 1, 9, 2),
    }


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
@torch.no_grad()
def test_a_late_person_is_distinguished_from_a_prompt_one(self_model, generator):
    late_person = type(load_human_model(f"{ROOT}/{EXAMPLE}", self_model))

    class InFullView(late_person):
        """Everybody sees everything, so that all the work goes into how they act."""

        def perceive(self, implants, knowledge, observation, told, step):
            everything = {
                name: value[0, 0] for name, value in sites.items() if not value.is_floating_point()
            }
            return super().perceive(everything, knowledge, observation, told, step)

    human = InFullView(self_model)
    sites = known(human, 2, reach_bin=len(human.domain.reach_bins) - 1)
    sites["late"] = torch.tensor([[0.9], [0.05]])
    recordings = play_rounds(human, sites, 20, "clear", generator)

    # Exact, given the other implants: one half lies far out in the tails of both posteriors.
    table = build_view_table(human, recordings)
    grid = torch.linspace(0.005, 0.995, 100)
    log_weights = dist.Beta(1.0, 4.0).log_prob(grid)[:, None].repeat(1, 2)
    for row, value in enumerate(grid):
        data = sites | {"late": value.expand(2, 1)}
        with poutine.condition(data=data), pyro.plate("person", 2, dim=-2):
            log_weights[row] += log_likelihoods(human, human.prior(), table).sum(-1)
    below_half = log_weights.softmax(0)[grid < 0.5].sum(0)
    assert below_half[0] < 1e-3
    assert below_half[1] > 1 - 1e-3

    # So half divides the posteriors of the fit too, which does not know the other implants.
    with torch.enable_grad():
        fit = fit_people(human, recordings, InferenceOptions(draws=100), 0, 20)
    late, prompt = (person["implants"]["late"] for person in fit.summary["people"])
    assert late["median"] > 0.5 > prompt["q95"]
    assert late["q05"] > prompt["q95"]


# --- common mistakes --------------------------------------------------------------------------


class NoSight(HumanModel):
    def prior(self):
        return {"late": pyro.sample("late", dist.Beta(1.0, 4.0))}


class SamplesInAct(HumanModel):
    def act(self, implants, belief, values):
        late = pyro.sample("late", dist.Beta(1.0, 4.0))
        return late[..., None] + super().act(implants, belief, values)


class MissingDimensions(HumanModel):
    def prior(self):
        return super().prior() | {"late": pyro.sample("late", dist.Beta(1.0, 4.0))}

    def act(self, implants, belief, values):
        return implants["late"] + super().act(implants, belief, values)


class LostAction(HumanModel):
    def act(self, implants, belief, values):
        return super().act(implants, belief, values)[..., :-1]


class UntoldMemory(HumanModel):
    def believe(self, belief, evidence, action, still=None):
        return torch.cat([super().believe(belief, evidence, action, still).mean, belief], -1)


class Probabilities(HumanModel):
    def act(self, implants, belief, values):
        return super().act(implants, belief, values).exp()


class ReadsContinuous(HumanModel):
    def perceive(self, implants, knowledge, observation, told, step):
        assert "lapse" in implants or implants["lapse"]
        return super().perceive(implants, knowledge, observation, told, step)


class ReadsWhatIsNotSampled(HumanModel):
    def prior(self):
        implants = super().prior()
        return implants | {"twice": 2 * implants["sight_front_own"]}

    def perceive(self, implants, knowledge, observation, told, step):
        assert (implants["twice"] >= 0).all()
        return super().perceive(implants, knowledge, observation, told, step)


class DependsOnSight(HumanModel):
    def prior(self):
        far = pyro.sample("far", dist.Normal(0.0, 1.0))
        return super().prior() | {"far": far, "mood": pyro.sample("mood", dist.Normal(far, 1.0))}

    def perceive(self, implants, knowledge, observation, told, step):
        assert implants["far"].isfinite().all()
        return super().perceive(implants, knowledge, observation, told, step)


class SampledTwice(HumanModel):
    def prior(self):
        consistency = pyro.sample("consistency", dist.LogNormal(1.0, 0.2))
        return super().prior() | {"consistency": consistency}


class NotAnEvent(HumanModel):
    def prior(self):
        return super().prior() | {"late": pyro.sample("late", dist.Normal(torch.zeros(2, 3), 1.0))}


class Endless(HumanModel):
    def prior(self):
        return super().prior() | {"late": pyro.sample("late", dist.Poisson(1.0))}


class Parameter(HumanModel):
    def prior(self):
        return super().prior() | {"late": pyro.param("late", torch.tensor(0.1))}


MISTAKES = [
    NoSight,
    SamplesInAct,
    MissingDimensions,
    LostAction,
    UntoldMemory,
    Probabilities,
    ReadsContinuous,
    ReadsWhatIsNotSampled,
    DependsOnSight,
    SampledTwice,
    NotAnEvent,
    Endless,
    Parameter,
]


def documented():
    """Messages of the page as patterns; three dots stand for anything."""
    messages = [row[0].strip("`") for row in table_of(page("docs/extending.md"), "Message")]
    return [re.escape(message).replace(r"\.\.\.", ".*") for message in messages]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_raise_what_the_page_says(mistake, results, self_model):
    recordings = load_demonstrations(results / "runs" / "people.nc")
    human = mistake(self_model)
    with pytest.raises(HumanModelError) as raised:
        check_contract(human)
        build_view_table(human, recordings)
    message = " ".join(str(raised.value).split())
    assert any(re.search(pattern, message) for pattern in documented()[3:]), message


@pytest.mark.parametrize(
    ("content", "name"),
    [("", ""), ("class Other: pass", ":Other"), ("1 / 0", ":Late")],
    ids=["no class", "another class", "does not import"],
)
def test_files_that_are_no_human_model_are_refused_as_the_page_says(
    content, name, tmp_path, self_model
):
    (tmp_path / "late.py").write_text(content)
    with pytest.raises(HumanModelError) as raised:
        load_human_model(f"{tmp_path}/late.py{name}", self_model)
    assert any(re.search(pattern, str(raised.value)) for pattern in documented()[:3])

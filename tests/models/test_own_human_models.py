"""Human models of users: that they are used as they are, and what is refused."""

import textwrap
import warnings

import pytest
import torch
from example_course import perceived
from example_implants import (
    ACTIONS,
    ASSUMED,
    SIGHTS,
    STEPS,
    first_round,
    nothing_told,
    policy,
    sight,
)

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError, MisspeltMember, UnreadSite
from mirror_ppl.inference.svi import SVIOptions, fit_implants
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    """Two people in fog, two rounds each."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return every.select_people([0, 3]).select_rounds(slice(0, 2))


HEAD = """
import pyro
import pyro.distributions as dist
import torch
from mirror_ppl.models import HumanModel, View
"""
HASTY = """
class Hasty(HumanModel):
    def prior(self):
        return {**super().prior(), "haste": pyro.sample("haste", dist.Beta(1.0, 4.0))}

    def act(self, implants, belief, values):
        haste = implants["haste"][..., None]
        return torch.log((1 - haste) * super().act(implants, belief, values).exp() + haste / 2)
"""
GLANCER = """
class Glancer(HumanModel):
    def prior(self):
        every = pyro.sample("every", dist.Categorical(torch.tensor([0.5, 0.3, 0.2])))
        return {**super().prior(), "every": every}

    def perceive(self, implants, knowledge, observation, told, step):
        view, knowledge = super().perceive(implants, knowledge, observation, told, step)
        looks = step % (implants["every"] + 1) == 0
        view.visible["visual"] = view.visible["visual"] & looks[..., None]
        return view, knowledge
"""


def user_model(tmp_path, human, code, name):
    path = tmp_path / "mine.py"
    path.write_text(HEAD + textwrap.dedent(code))
    return load_human_model(f"{path}:{name}", human.self_model)


@pytest.mark.parametrize(
    ("code", "name", "site"), [(HASTY, "Hasty", "haste"), (GLANCER, "Glancer", "every")]
)
def test_model_with_a_new_site_works_unchanged(tmp_path, human, recordings, code, name, site):
    mine = user_model(tmp_path, human, code, name)
    check_contract(mine)
    one = recordings.select_rounds([0]).select_people([0])
    whole = build_view_table(mine, one, [torch.arange(0, 9604, 100)])
    assert (site in whole.sites) == (site == "every")
    posterior = fit_implants(ViewTables(mine, whole), SVIOptions(steps=2), 6, seed=0)
    draws = posterior.draws
    assert set(draws) == {*SIGHTS, *ASSUMED, *policy(human), site}
    assert draws[site].shape == (6, 1, 1)
    assert ((draws[site] >= 0) & (draws[site] <= 2)).all()
    # Combinations that were not looked at are never drawn.
    combination = whole.combination({name: draws[name] for name in whole.sites})
    assert (whole.index[0, 0, combination.flatten()] != NO_VIEW).all()
    predicted = predict_actions(mine, whole, draws)
    assert predicted.shape == (6, 1, 1, STEPS, ACTIONS)
    torch.testing.assert_close(predicted.exp().sum(-1), torch.ones(6, 1, 1, STEPS))


def test_models_own_methods_are_called(tmp_path, human, recordings):
    mine = user_model(tmp_path, human, GLANCER, "Glancer")
    observation, _ = first_round(recordings)
    implants = sight(front_own=6, front_other=6) | {"every": torch.tensor([0])}
    told = nothing_told(STEPS)
    often = perceived(mine, implants, observation, told).visible["visual"]
    rarely = perceived(mine, {**implants, "every": torch.tensor([2])}, observation, told)
    looks = torch.arange(STEPS) % 3 == 0
    assert often.any()
    assert torch.equal(rarely.visible["visual"], often & looks[:, None])


@pytest.mark.parametrize(
    ("specification", "message"),
    [
        ("mine.py", r'"mine\.py" is not of the form path/to/file\.py:Class'),
        ("mine.py:My-Class", "is not of the form"),
        ("miror", 'perhaps you meant "mirror"'),
        ("nowhere.py:Mine", r"nowhere\.py: there is no such file"),
        (".:Mine", "is not a regular file"),
        ("mine.txt:Mine", "not a Python file"),
        ("mine.py:Other", r"no class Other derived from .*HumanModel; it has: Mine, Naughty"),
        ("mine.py:pyro", "no class pyro derived from"),
        ("mine.py:Naughty", r"Naughty cannot be made: KeyError: 'naught' \(mine\.py, line 11\)"),
        (
            "broken.py:Mine",
            r"broken\.py does not import: ZeroDivisionError.*\(broken\.py, line 3\)",
        ),
        ("syntax.py:Mine", r"syntax\.py does not import: SyntaxError"),
        ("needs.py:Mine", r"does not import: ModuleNotFoundError: No module named 'nonesuch'"),
    ],
)
def test_what_is_not_a_human_model_is_refused(tmp_path, monkeypatch, human, specification, message):
    monkeypatch.chdir(tmp_path)
    code = """
        class Mine(HumanModel):
            pass
        class Naughty(HumanModel):
            def __init__(self, self_model):
                {}["naught"]
        """
    (tmp_path / "mine.py").write_text(HEAD + textwrap.dedent(code))
    (tmp_path / "mine.txt").write_text("no code")
    (tmp_path / "broken.py").write_text("a = 1\nb = 0\na / b\n")
    (tmp_path / "syntax.py").write_text("class Mine(:\n")
    (tmp_path / "needs.py").write_text("import nonesuch\n")
    with pytest.raises(HumanModelError, match=message) as caught:
        load_human_model(specification, human.self_model)
    assert "\n" not in str(caught.value)
    assert type(load_human_model(None, human.self_model)) is HumanModel


@pytest.mark.parametrize(
    ("method", "body", "message"),
    [
        ("prior(self)", "return 1 / 0", r"Mine\.prior fails: ZeroDivisionError.*mine\.py, line 9"),
        ("prior(self)", "return None", "prior returned NoneType, expected a dict of sites"),
        (
            "perceive(self, implants, knowledge, observation, told, step)",
            "return torch.zeros(2) + torch.zeros(3)",
            r"Mine\.perceive fails: RuntimeError.*mine\.py, line 9",
        ),
        (  # no line, as it is the package's
            "act(self, implants, belief, values, step)",
            "return values",
            r"Mine\.act fails: TypeError: [^(]*act\(\) missing 1 required [^(]*'step'$",
        ),
        ("perceive(self, implants)", "return None", r"Mine\.perceive fails: TypeError"),
        (
            "perceive(self, *now)",
            "return super().perceive(*now)[0], {}",
            "perceive returned dict as knowledge, expected a dataclass of tensors",
        ),
        (
            "nothing_known(self, *batch, device=None)",
            "return torch.zeros(*batch)",
            "nothing_known returned Tensor, expected a dataclass of tensors",
        ),
        (
            "perceive(self, *now)",
            "return None",
            r"perceive returned NoneType, expected \(View, know",
        ),
        (
            "perceive(self, *now)",
            "return super().perceive(*now)[0]",
            r"perceive returned View, expected \(View, knowledge\): what is perceived "
            r"\(mirror_ppl\.models\.View\), and the person's memory after this step",
        ),
        (
            "perceive(self, *now)",
            "return super().perceive(*now)[::-1]",
            r"perceive returned \(CarKnowledge, View\), expected \(View, knowledge\)",
        ),
        ("evidence(self, view, observation)", "return view.seen", r"Mine\.evidence fails: Attr"),
        ("believe(self, *now)", "return None", r"Mine\.believe fails"),
        (
            "believe(self, belief, evidence, action, still=None)",
            "return torch.cat([belief, belief], -1)",
            r"believe returned shape \(2, 96\), expected \(2, 48\) for 2 beliefs",
        ),
        (
            "sees(self, implants, observation, step)",
            'return {"vision": observation["visual"][..., 0] > 0}',
            "sees returned vision, expected a dict with a mask of each modality: visual, verbal",
        ),
        (
            "sees(self, implants, observation, step)",
            "return None",
            "sees returned NoneType, expected a dict with a mask of each modality",
        ),
        (
            "sees(self, implants, observation, step)",
            'return {name: observation[name][..., 0] for name in ("visual", "verbal")}',
            'sees returned torch.float32 for "visual", expected a tensor of torch.bool',
        ),
        (
            "sees(self, implants, observation, step)",
            'return {name: observation[name] > 0 for name in ("visual", "verbal")}',
            r'sees returned shape \(2, 4, 2\) for "visual", expected \(2, 4\) for',
        ),
        (
            "act(self, implants, belief, values)",
            "return values.double().log_softmax(-1)",
            r"act returned torch\.float64, expected torch\.float32; numpy's numbers make",
        ),
        (
            "believe(self, belief, evidence, action, still=None)",
            "return belief.double()",
            r"believe returned torch\.float64, expected torch\.float32",
        ),
        (
            "act(self, implants, belief, values)",
            "return values[..., 0]",
            r"act returned shape \(2, 1\), expected \(2, 1, 2\)",
        ),
        (
            "perceive(self, implants, knowledge, observation, told, step)",
            'return implants["dreams"]',
            r'perceive\(\) reads "dreams", which is no site that prior\(\)',
        ),
        ("act(self, implants, belief, values)", "return values", "they do not sum to 1"),
        (
            "act(self, implants, belief, values)",
            'return implants["mood"]',
            r"act fails: NotReturned: 'mood' \(mine\.py, line 9\); prior\(\) does not return that",
        ),
        (
            "prior(self)",
            'kept = super().prior(); del kept["lapse"]; return kept',
            r"Mine\.act fails: NotReturned: 'lapse' .*; prior\(\) does not return that",
        ),
        (
            "round_latents(self, implants)",
            'return {"mood": implants["mood"]}',
            r"round_latents fails: NotReturned: 'mood' .*by its name \(of covariates, use \.get\)$",
        ),
        (
            "prior(self)",
            'return super().prior() | {"mood": pyro.sample("mood", dist.Normal(0.0, 1e30))}',
            'the log density of "mood" in prior is not finite: check the parameters',
        ),
        (
            "prior(self)",
            'return super().prior() | {"mood": pyro.sample("mood", dist.Uniform(0.0, torch.inf))}',
            'the log density of "mood" in prior is not finite',
        ),
        (
            "prior(self)",
            'name = "sight_front_own"; hidden = pyro.poutine.block(super().prior, hide=[name])(); '
            "return hidden | {name: pyro.sample(name, dist.Categorical(torch.ones(9)))}",
            '"sight_front_own" has 9 values, but driving has 7 reach_bins',
        ),
        (
            "prior(self)",
            'name = "sight_radius"; own = pyro.sample(name, dist.Categorical(torch.ones(9))); '
            "return super().prior() | {name: own}",
            '"sight_radius" has 9 values, .*; a site that is no threshold needs a name without',
        ),
        (
            "nothing_known(self, *batch, device=None)",
            "import dataclasses; known = super().nothing_known(*batch, device=device); "
            "return dataclasses.replace(known, position=torch.zeros(()))",
            r"nothing_known returned position of shape \(\), expected \(2, \.\.\.\) for 2 people",
        ),
        (
            "act(self, implants, belief, values)",
            'return values + pyro.sample("mood", dist.Beta(1.0, 4.0))[..., None]',
            'act samples "mood" at every step; sample it in prior',
        ),
        (
            "act(self, implants, belief, values)",
            'return values.log_softmax(-1) + 0 * pyro.param("mood", torch.ones(()))',
            '"mood" is a pyro.param',
        ),
        (
            "prior(self)",
            'pyro.sample("mood", dist.Poisson(3.0)); return super().prior()',
            '"mood" is discrete without finite support',
        ),
        (
            "prior(self)",
            'pyro.sample("mood", dist.Normal(torch.zeros(5), 1.0)); return super().prior()',
            r'"mood" has batch shape \(2, 5\), expected \(2, 1\) for 2 people',
        ),
        (
            "prior(self)",
            'pyro.param("mood", torch.ones(())); return super().prior()',
            '"mood" is a pyro.param',
        ),
    ],
)
def test_a_broken_contract_is_reported_before_any_work(tmp_path, human, method, body, message):
    code = f"""
        class Mine(HumanModel):
            def {method}:
                {body}
        """
    mine = user_model(tmp_path, human, code, "Mine")
    state = torch.random.get_rng_state()
    with pytest.raises(HumanModelError, match=message):
        check_contract(mine)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize(
    ("returned", "used", "said"),
    [
        ("{}", "", ["mood"]),
        ('{"tiredness": mood}', "", ["mood"]),
        ('{"mood": mood}', "", ["mood"]),
        ('{"mood": mood}', 'found = found + 0.1 * implants["mood"][..., None]', []),
        # Provenance is lost where a value is assigned.
        ('{"mood": mood}', 'found[..., :1] = implants["mood"][..., None]', []),
        # It may be measured.
        ('{"other": pyro.sample("other", dist.Normal(mood, 1.0))}', "", []),
        ('{"other": pyro.sample("other", dist.Normal(0.0, 1.0))}', "", ["mood", "other"]),
    ],
)
def test_a_site_that_nothing_reads_is_named(tmp_path, human, returned, used, said):
    code = f"""
        class Mine(HumanModel):
            def prior(self):
                mood = pyro.sample("mood", dist.Normal(0.0, 1.0))
                return super().prior() | {returned}

            def act(self, implants, belief, values):
                found = super().act(implants, belief, values).clone()
                {used}
                return found.log_softmax(-1)
        """
    mine = user_model(tmp_path, human, code, "Mine")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_contract(mine)
    names = ", ".join(f'"{name}"' for name in said)
    expected = [
        f"nothing in Mine was found to depend on {names}, so that the posterior is the prior"
    ]
    assert [str(one.message).partition(":")[0] for one in told] == expected[: len(said)]
    assert all(one.category is UnreadSite for one in told)


def test_memory_may_be_the_same_for_all_people(tmp_path, human):
    code = """
        class Timed(HumanModel):
            def nothing_known(self, *batch, device=None):
                return Timer(super().nothing_known(*batch, device=device), torch.zeros(*batch, 1))

            def perceive(self, implants, knowledge, observation, told, step):
                view, cars = super().perceive(implants, knowledge.cars, observation, told, step)
                return view, Timer(cars, torch.full((1, 1), float(step)))

        import dataclasses

        @dataclasses.dataclass
        class Timer:
            cars: object
            time: torch.Tensor
        """
    check_contract(user_model(tmp_path, human, code, "Timed"))


def test_a_misspelt_method_is_named(tmp_path, human):
    code = """
class Habit(HumanModel):
    def actt(self, implants, belief, values):
        return values

    def _beleive(self):
        return None

    def habits(self):
        return None
"""
    path = tmp_path / "habit.py"
    path.write_text("from mirror_ppl import HumanModel\n" + code)
    with pytest.warns(MisspeltMember, match="actt of Habit is no member .* you meant act$") as told:
        load_human_model(f"{path}:Habit", human.self_model)
    assert len(told) == 1


def test_own_model_keeps_the_contract(human):
    state = torch.random.get_rng_state()
    check_contract(human)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not any(part.requires_grad for part in human.parameters())

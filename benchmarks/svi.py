"""What Pyro costs: a gradient step of the ELBO beside the same loss by hand in torch.

Both have the same table of views, the same mean-field guide over the continuous sites and the exact
sum over all combinations of the discrete ones, and give the same loss for the same draw. Printed is
the median time of a step of each, taken in turns, and their ratio.
"""

from __future__ import annotations

import argparse
from statistics import median
from time import perf_counter

import pyro
import torch
from torch import Tensor
from torch.distributions import biject_to

from mirror_ppl.inference.marginal_elbo import MarginalELBO
from mirror_ppl.inference.svi import continuous_guide
from mirror_ppl.likelihood.combinations import log_priors, perceived_sites
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.grid import grid_of
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import residual
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate


class ByHand(torch.nn.Module):
    """The negative ELBO of the package's own human model, without Pyro's handlers."""

    def __init__(self, human: HumanModel, table: ViewTable) -> None:
        super().__init__()
        self.table = table
        nodes = sample_sites(human, table.people)
        discrete = set(perceived_sites(human))
        self.priors = {name: node["fn"] for name, node in nodes.items() if name not in discrete}
        self.loc, self.scale = torch.nn.ParameterDict(), torch.nn.ParameterDict()
        for name, fn in self.priors.items():
            value = torch.zeros(fn.batch_shape + fn.event_shape)
            self.loc[name] = torch.nn.Parameter(value.clone())
            self.scale[name] = torch.nn.Parameter(value - 1.0)
        prior = log_priors(human, grid_of(perceived_sites(human)), {}, 1)[0].expand(
            table.people, -1
        )
        kept = [own[some] for own, some in zip(prior, table.possible, strict=True)]
        # Padding has no probability.
        self.log_prior = torch.nn.utils.rnn.pad_sequence(kept, True, -torch.inf)

    def forward(self, noise: dict[str, Tensor]) -> Tensor:
        """Loss for a draw of standard normal numbers."""
        table, total, implants = self.table, torch.zeros(()), {}
        for name, fn in self.priors.items():
            width = torch.nn.functional.softplus(self.scale[name])
            place = self.loc[name] + width * noise[name]
            onto = biject_to(fn.support)
            implants[name] = value = onto(place)
            stretch = onto.log_abs_det_jacobian(place, value)
            density = torch.distributions.Normal(self.loc[name], width).log_prob(place)
            total = total + fn.log_prob(value).sum() + stretch.sum() - density.sum()
        logits = implants["consistency"][..., None] * table.values
        logits = logits + residual(implants, table.belief)
        lapse = implants["lapse"][..., None]
        aware = torch.log1p(-lapse) + torch.log_softmax(logits, -1)
        actions = torch.logaddexp(aware, torch.log(lapse / logits.shape[-1]).expand_as(aware))
        acted = table.acted.expand(actions.shape[:-1])[..., None]
        likelihood = table.along_views(actions.gather(-1, acted).squeeze(-1))  # [P, V]
        scores = table.scores(likelihood)  # [P, C]
        return -(total + torch.logsumexp(scores + self.log_prior, -1).sum())


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    recordings = simulate("driving", "fog", "paper", options.people, options.rounds, 0)
    table = build_view_table(human, recordings, screening=Screening())
    pyro.set_rng_seed(0)
    compiled = ViewTables(human, table)
    guide = continuous_guide(compiled)

    def elbo(_: ViewTable) -> Tensor:
        with pyro.settings.context(module_local_params=True):
            return MarginalELBO(compiled).differentiable_loss(compiled.program, guide)

    by_hand = ByHand(human, table)
    print(f"the same loss: {difference(by_hand, guide, elbo, table):.1e} nats apart")
    steps = {"pyro": (elbo, (table,)), "by hand": (by_hand, None)}
    optimizers = {
        "pyro": torch.optim.Adam(guide.parameters()),
        "by hand": torch.optim.Adam(by_hand.parameters()),
    }
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(options.repeats):
        for name, (loss, given) in steps.items():
            began = perf_counter()
            optimizers[name].zero_grad()
            if given is None:
                given = ({n: torch.randn_like(v) for n, v in by_hand.loc.items()},)
            with pyro.validation_enabled(False):  # as fitting does after its first step
                loss(*given).backward()
            optimizers[name].step()
            times[name].append(1000 * (perf_counter() - began))
    each = {name: median(values[2:]) for name, values in times.items()}
    views, combinations = int(table.view_counts.sum()), table.index.shape[-1]
    print(f"{options.people} people, {views} views, {combinations} combinations, ms a step:")
    for name, value in each.items():
        print(f"  {name:8s} {value:6.1f}")
    print(f"  ratio    {each['pyro'] / each['by hand']:.2f}")


def difference(by_hand: ByHand, guide, elbo, table: ViewTable) -> float:
    """Nats between the two losses, of the same guide and draw."""
    noise = {}
    torch.manual_seed(1)
    with torch.no_grad():
        drawn = guide()
        for name, fn in by_hand.priors.items():
            loc, scale = guide._get_loc_and_scale(name)
            by_hand.loc[name].copy_(loc)
            by_hand.scale[name].copy_(torch.log(torch.expm1(scale)))
            noise[name] = (biject_to(fn.support).inv(drawn[name]) - loc) / scale
    torch.manual_seed(1)
    return float((elbo(table) - by_hand(noise)).detach().abs())


if __name__ == "__main__":
    main()

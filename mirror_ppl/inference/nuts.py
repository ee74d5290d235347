"""Hamiltonian Monte Carlo (NUTS), to compare other guides with on small problems."""

from __future__ import annotations

import pyro
import torch
from pyro.infer import MCMC, NUTS
from pyro.infer.autoguide import init_to_median

from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.likelihood.enumeration import (
    draw_combinations,
    log_joints,
    require_acting_on_beliefs,
)
from mirror_ppl.likelihood.table_program import TableProgram
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.progress import Report, silent

WARMUP = 200


def sample_nuts(
    human: HumanModel, table: ViewTable, number: int, seed: int, report: Report = silent
) -> Draws:
    """Joint draws ``[S, P, 1, ...]`` of all sites, of one chain; they depend on each other.

    Discrete sites are marginalized while the chain runs, and drawn afterwards.

    Args:
        human: the model of people.
        table: views of the rounds to learn from.
        number: of draws S; as many as ``WARMUP`` are thrown away before.
        seed: of everything random.
        report: told of steps.

    Raises:
        HumanModelError: actions depend on what is seen otherwise than through beliefs.
    """
    require_acting_on_beliefs(human, table)
    total, done = WARMUP + number, 0

    def count(*_: object) -> None:
        nonlocal done
        done += 1
        report("sample", min(done, total), total, "")

    with torch.random.fork_rng(devices=[]), pyro.validation_enabled(False):
        torch.manual_seed(seed)
        kernel = NUTS(
            TableProgram(human),
            max_plate_nesting=PLATES,
            init_strategy=init_to_median,
            max_tree_depth=6,
        )
        chain = MCMC(kernel, number, WARMUP, hook_fn=count, disable_progbar=True)
        chain.run(table)
        policy = chain.get_samples()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        joints = log_joints(human, table, policy)
        discrete = [draw_combinations(human, table, joint, 1) for joint in joints]
    drawn = {name: torch.cat([one[name] for one in discrete]) for name in discrete[0]}
    values = {**policy, **drawn}
    return {name: values[name] for name in sample_sites(human, 1)}

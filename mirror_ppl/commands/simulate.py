"""`python -m mirror_ppl.simulate`: record rounds of simulated people."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mirror_ppl.console import command_line
from mirror_ppl.devices import usable_device
from mirror_ppl.errors import OptionError
from mirror_ppl.limits import check_numbers, require_memory
from mirror_ppl.progress import Progress

if TYPE_CHECKING:
    from mirror_ppl.data import Demonstrations

PROGRAM = "python -m mirror_ppl.simulate"
COPIES = 4
"""Number of copies of recordings in memory while they are made, checked and saved."""
DESCRIPTION = """Record rounds of simulated people, whose sight and consistency are known, in a file
for python -m mirror_ppl.fit. docs/people.md describes the people."""
EXAMPLES = {
    "ten people who drive in fog": (
        "--setting fog --people 10 --rounds 40 --seed 1 --out runs/people.nc"
    ),
    "four people who react late, drawn from the prior": (
        "--human-model late --people 4 --out runs/late.nc"
    ),
}
"""Arguments, by what they are for."""


@dataclass(frozen=True)
class Options:
    """What to record."""

    out: Path
    """The netCDF file to write; one that is there is replaced, missing folders are created."""
    domain: str = "driving"
    """The world: driving (two lanes, four cars that never yield), search_rescue (a burning house,
    a victim, two corridors), bomb_defusal (three stages, six terminals) or highway (three lanes,
    lidar); or one of your own, path/to/file.py:Class, whose code is run
    (docs/adding_a_world.md)."""
    setting: str | None = None
    """Its setting: of driving clear (the whole road in sight) or fog (2 cells ahead, nothing
    behind), of search_rescue clear (the whole house in sight) or smoke (1.5 cells around), of
    bomb_defusal labelled (the type can be read) or unlabelled, of highway clear or fog (15 m ahead,
    5 m behind). Default: the one in which people see less."""
    population: str = "paper"
    """Who: paper (sight limited by the setting alone; in bomb_defusal as quick at every terminal)
    or diverse (each their own sight)."""
    human_model: str | None = None
    """People drawn from the prior of a human model instead: one of the package's, such as late, or
    path/to/file.py:Class, whose code is run. What they see depends on their implants."""
    self_model: Path | None = None
    """Weights of the robot that people of a --human-model, and those of a world of your own, are
    made of. Default: those that ship, or that python -m mirror_ppl.train wrote."""
    people: int = 10
    """How many people, at least 1."""
    rounds: int = 40
    """How many rounds each of them plays, at least 1."""
    told: float = 0.0
    """Probability that an item that can be communicated is, at each step, whether it helps or not:
    such rounds show how people use messages."""
    seed: int = 0
    """The same seed gives the same people in every setting, and the same command the same file."""
    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:0."""

    def __post_init__(self) -> None:
        if self.human_model is not None and self.population != "paper":
            raise OptionError("--population is not of people who are drawn from a --human-model")
        check_numbers(self, "people", "rounds", "seed")
        if not 0 <= self.told <= 1:
            raise OptionError(f"--told must be from 0 to 1, not {self.told}")


def main(options: Options) -> None:
    """Simulate, write, and tell what was written.

    Raises:
        UnknownNameError: there is no such domain, setting, population or device.
        OutputError: the file cannot be written.
    """
    from mirror_ppl.data import save_demonstrations
    from mirror_ppl.domains import get_domain
    from mirror_ppl.files import lock_of, output_folder
    from mirror_ppl.people import people_of, simulate

    domain = get_domain(options.domain)
    if options.self_model is not None and options.human_model is None and people_of(domain.name):
        raise OptionError(
            f"--self-model has no effect on the simulated people of {domain.name}, who are not "
            "made of it; leave it out"
        )
    setting = domain.settings[-1] if options.setting is None else options.setting
    device = usable_device(options.device)
    require_memory(_bytes(options), "rounds of so many people")
    folder = output_folder(options.out.parent, [options.out.name], lock_of(options.out))
    with folder, Progress("simulate", domain.horizon) as progress:
        if options.human_model is not None:
            demonstrations = _of_a_model(options, setting, device)
        else:
            demonstrations = simulate(
                options.domain,
                setting,
                options.population,
                options.people,
                options.rounds,
                options.seed,
                device,
                progress,
                options.told,
                options.self_model,
            )
        provenance = {**demonstrations.provenance, "command": _command(options)}
        path = save_demonstrations(options.out, replace(demonstrations, provenance=provenance))

    assert demonstrations.rewards is not None and demonstrations.action_entropy is not None
    reward = demonstrations.rewards.nansum(-1).mean().item()
    entropy = demonstrations.action_entropy.nanmean().item()
    population = demonstrations.provenance["population"]
    print(f"{path}: {domain.name}, {setting}, population {population}")
    print(f"  people {options.people}, rounds of each {options.rounds}, seed {options.seed}")
    print(f"  mean reward of a round {reward:.3f}")
    print(f"  mean entropy of an action {entropy:.4f} nats")


def _of_a_model(options: Options, setting: str, device: str) -> Demonstrations:
    from mirror_ppl.domains import get_domain
    from mirror_ppl.models.loading import load_human_model
    from mirror_ppl.models.simulation import simulate_from_prior
    from mirror_ppl.models.weights import load_self_model, shipped_weights

    domain = get_domain(options.domain).name
    self_model, _ = load_self_model(options.self_model or shipped_weights(domain), domain)
    human = load_human_model(options.human_model, self_model).to(device)
    return simulate_from_prior(
        human, options.people, options.rounds, setting, options.seed, options.told
    )


def _bytes(options: Options) -> int:
    """About how much memory the recordings take, and copies that are made of them."""
    from mirror_ppl.domains import get_domain

    domain = get_domain(options.domain)
    values = sum(len(m.items) * (len(m.features) + 1) for m in domain.modalities)
    times = options.people * options.rounds * (domain.horizon + 1)
    return COPIES * 4 * times * (values + len(domain.ego_features) + 3)


def _command(options: Options) -> str:
    """The command that makes the same recordings again, wherever it is to write them."""
    from mirror_ppl.domains import get_domain

    values = {part.name: getattr(options, part.name) for part in fields(options)}
    if options.setting is None:
        values["setting"] = get_domain(options.domain).settings[-1]
    unsaid = {"out", "population"} if options.human_model else {"out"}
    if not options.told:
        unsaid.add("told")
    return command_line(PROGRAM, {name: values[name] for name in values if name not in unsaid})

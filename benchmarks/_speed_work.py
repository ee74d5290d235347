"""One measurement of benchmarks/speed.py, by the package of the folder that it is started in.

Run as a file, not as a module: folders of older versions lack it. Names have changed since version
0.1.0, so that they are looked for under both. Printed is one line of JSON.
"""

import json
import sys
from importlib import import_module
from statistics import median
from time import perf_counter

import torch

ROUNDS = 20
MOMENTS = 40
MODULES = {
    "fit_people": ("inference.results.fitting", "inference.fitting"),
    "InferenceOptions": ("inference.engines", "inference.guides"),
    "load_guide": ("training.guide_file", "inference.guide_file"),
    "shipped_guide": ("training.guide_file", "inference.guide_file"),
    "Person": ("communication",),
}


def named(name, *other):
    """What the package calls so, wherever it stands."""
    for module in MODULES[name]:
        try:
            found = import_module(f"mirror_ppl.{module}")
        except ImportError:
            continue
        for one in (name, *other):
            if hasattr(found, one):
                return getattr(found, one)
    raise SystemExit(f"the package has no {name}")


def human_and_rounds(domain, setting, people):
    """The package's own human model of a world, and rounds of simulated people that ship."""
    from mirror_ppl.data import asset_path, load_demonstrations
    from mirror_ppl.models.loading import load_human_model
    from mirror_ppl.models.weights import load_self_model, shipped_weights

    recordings = load_demonstrations(asset_path(f"{domain}_{setting}_paper.nc"))
    recordings = recordings.select_people(recordings.people[:people])
    self_model, _ = load_self_model(shipped_weights(domain), domain)
    human = load_human_model(None, self_model)
    if hasattr(human, "fit_world"):  # what rewards tell of the rules, as every fit learns it
        human.fit_world(recordings)
    return human, recordings


def planner(human, recordings, draws=64, seed=0, **settings):
    """A communicator for one recorded driver, who is fitted first; settings of the objective."""
    import mirror_ppl.communication as communication

    options = named("InferenceOptions")(draws=draws)
    posterior = named("fit_people")(human, recordings, options, seed=seed).posterior
    person = named("Person")(human, posterior.draws)
    dynamics = next(
        getattr(communication, name)
        for name in ("SimulatorDynamics", "SimulatorWorld")
        if hasattr(communication, name)
    )
    objective = communication.ExpectedUtility(dynamics(human.domain), **settings)
    return communication.Communicator(person, objective)


def moments(recordings, number):
    """Moments of one driver's rounds that were not learned from."""
    from mirror_ppl.communication import RoundSoFar

    observation = recordings.observation()
    for place in range(number):
        index, step = ROUNDS + place % 10, place * 7 % recordings.actions.shape[-1]
        yield RoundSoFar(
            {name: value[0, index, : step + 1] for name, value in observation.items()},
            recordings.actions[0, index, :step],
            {name: mask[0, index, :step] for name, mask in recordings.told.items()},
        )


def plan():
    """Milliseconds of decisions with the default settings, in recorded moments of one driver."""
    human, recordings = human_and_rounds("driving", "fog", 1)
    communicator, seconds = planner(human, recordings), []
    for past in moments(recordings, MOMENTS):
        began = perf_counter()
        communicator.plan(past)
        seconds.append(perf_counter() - began)
    return {"median_ms": 1e3 * median(seconds[1:]), "slowest_ms": 1e3 * max(seconds[1:])}


def decide(people, each):
    """Messages with the default settings, as flags of items, in recorded moments of drivers."""
    human, recordings = human_and_rounds("driving", "fog", people)
    found = []
    for name in recordings.people:
        own = recordings.select_people([name])
        communicator = planner(human, own)
        for past in moments(own, each):
            found.append(communicator.plan(past).flags.int().tolist())
    return {"flags": found}


def add(domain, setting, network):
    """Milliseconds to add a round to a person's posterior and draw 200, over three people."""
    from mirror_ppl.inference.online import OnlinePosterior

    human, recordings = human_and_rounds(domain, setting, 3)
    guide = named("load_guide")(named("shipped_guide")(domain), human)[0] if network else None
    first, others = [], []
    for name in recordings.people:
        own = recordings.select_people([name])
        online = OnlinePosterior(human, guide)
        for number in range(ROUNDS):
            one = own.select_rounds([number])
            began = perf_counter()
            online.add(one)
            online.draws(200)
            (others if number else first).append(perf_counter() - began)
    return {"first_ms": 1e3 * median(first), "median_ms": 1e3 * median(others)}


def arrive(domain, setting):
    """Milliseconds to the posterior of a new person with 20 rounds, by the network, of five."""
    from mirror_ppl.inference.online import OnlinePosterior

    human, recordings = human_and_rounds(domain, setting, 6)
    guide = named("load_guide")(named("shipped_guide")(domain), human)[0]
    seconds = []
    for name in recordings.people:
        own = recordings.select_people([name]).select_rounds(list(range(ROUNDS)))
        began = perf_counter()
        online = OnlinePosterior(human, guide)
        online.add(own)
        online.draws(200)
        seconds.append(perf_counter() - began)
    return {"median_ms": 1e3 * median(seconds[1:])}


def main():
    """Measure what the command line names."""
    torch.set_num_threads(1)
    what, *arguments = sys.argv[1:]
    if what == "plan":
        found = plan()
    elif what == "decide":
        found = decide(*map(int, arguments))
    elif what == "arrive":
        found = arrive(*arguments)
    else:
        found = add(arguments[0], arguments[1], arguments[2] == "network")
    print(json.dumps(found))


if __name__ == "__main__":
    main()

"""`python -m mirror_ppl.evaluate`: the paper's comparisons, one command each."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from mirror_ppl.console import Progress, run
from mirror_ppl.errors import OptionError, UnknownNameError

if TYPE_CHECKING:
    from mirror_ppl.domains import Domain, Observation
    from mirror_ppl.evaluation.study_summary import Interval, Place, Share, Standing
    from mirror_ppl.evaluation.sweep import Outcome, Rows
    from mirror_ppl.plots.picture import Picture

PROGRAM = "python -m mirror_ppl.evaluate"
DESCRIPTION = """Compare MIRROR with its parts and its rivals on simulated people. prediction: how
well each predicts held-out actions, by the number of rounds that it learned from. assistance: the
net return of people who are spoken to by communicators that plan with each. relevance: which share
of what those tell is relevant. Writes a table of every person (CSV), a summary (JSON) and a figure.
A run that is stopped goes on where it was when the same command is given again; the exit status is
1 if something failed."""
CODE = (
    *(f"{name}/**/*.py" for name in ("baselines", "communication", "data", "domains")),
    *(f"{name}/**/*.py" for name in ("inference", "models", "people")),
    *(f"evaluation/{name}.py" for name in ("assistance", "learners", "oracle", "study")),
    "evaluation/reachable_oracle.py",
)
"""Files whose change makes earlier results worthless."""
FAILED = 1
WIDTH = 100


@dataclass(frozen=True)
class Options:
    """What to compare, in whom, and where the results go."""

    study: Positional[Literal["prediction", "assistance", "relevance"]]
    """What is compared."""
    domain: tuple[str, ...] = ("driving",)
    """One or several worlds: driving, search_rescue, bomb_defusal."""
    setting: tuple[str, ...] = ()
    """Settings: by default all of prediction, and the one in which people see least otherwise."""
    population: str = "paper"
    """Which simulated people: paper or diverse."""
    people: int = 10
    """People of each seed."""
    seeds: int | None = None
    """Seeds 0, 1 and so on, of people and rounds; 5 of prediction, otherwise 2, unless given."""
    models: tuple[str, ...] = ()
    """What is compared; by default everything that fits the study: mirror, mirror-amortized,
    mirror-svi, mirror-population, perceptual-only, policy-only, no-implants, bc,
    bc-everything, sqil, sqil-everything, logistic, or of assistance and relevance mirror, bc, sqil,
    none, all, oracle."""
    rounds: tuple[int, ...] = (1, 2, 5, 10, 20)
    """Numbers of rounds that are learned from, from 1 to 20; the most only, for relevance."""
    played: int = 5
    """Rounds of each person in which they are spoken to."""
    draws: int = 64
    """Posterior draws that are planned with."""
    out: Path = Path("runs/evaluate")
    """Folder for the results; made if it is not there."""
    jobs: int = -1
    """Processes on this machine; -1 for one a core."""
    scheduler: str | None = None
    """Address of a Dask cluster that does the work instead, such as tcp://host:8786."""

    def __post_init__(self) -> None:
        for name in ("people", "seeds", "played", "draws"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise OptionError(f"--{name} must be at least 1, not {number}")
        if not self.domain:
            raise OptionError("--domain needs at least one world")
        wrong = [number for number in self.rounds if not 1 <= number <= 20]  # noqa: PLR2004
        if wrong or not self.rounds:
            raise OptionError(
                f"--rounds must be from 1 to 20, not {', '.join(map(str, wrong)) or 'none'}"
            )
        if self.jobs == 0 or self.jobs < -1:
            raise OptionError(f"--jobs must be at least 1, or -1 for all, not {self.jobs}")


def main(options: Options) -> int:
    """Compare, write the results, print what was found.

    Returns:
        The exit status: 1 if a part failed.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    from mirror_ppl.evaluation.study import assist, predict
    from mirror_ppl.evaluation.sweep import run_cells
    from mirror_ppl.files import prepare_output_folder, write_whole

    cells = _cells(options)
    folder = prepare_output_folder(options.out)
    parts = prepare_output_folder(folder / "parts")
    work = predict if options.study == "prediction" else assist
    with Progress(options.study, len(cells)) as progress:
        outcomes = run_cells(
            cells,
            work,
            parts,
            _identities(options.domain),
            options.jobs,
            options.scheduler,
            progress.update,
        )
    rows = [row for outcome in outcomes for row in outcome.rows]
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    if rows:
        path = folder / f"{options.study}.csv"
        write_whole(path, lambda temporary: _write_table(temporary, rows))
        show = {"prediction": _prediction, "assistance": _assistance, "relevance": _relevance}
        summary, picture = show[options.study](rows)
        command = {name: value for name, value in asdict(options).items() if name != "jobs"}
        content = {"command": PROGRAM, "options": command, **summary, **_effort(outcomes)}
        text = json.dumps(content, indent=1, default=_plain) + "\n"
        write_whole(folder / f"{options.study}.json", lambda temporary: temporary.write_text(text))
        picture.save(folder / f"{options.study}.png")
        print(f"{path}: a row for each person, model and number of rounds")
        print(f"{path.with_suffix('.json')}: means, differences and intervals")
        print(f"{path.with_suffix('.png')}: the same as a picture")
    for outcome in failed:
        print(f"failed: {outcome.cell.label}: {outcome.error}")
    return FAILED if failed else 0


def _cells(options: Options) -> list[Any]:
    """What is to be done; the slowest first, so that no process waits for another at the end."""
    from mirror_ppl.domains import get_domain, require_known
    from mirror_ppl.evaluation.learners import LEARNERS, PLANNABLE
    from mirror_ppl.evaluation.study import REFERENCES, Assistance, Prediction
    from mirror_ppl.people import PEOPLE

    predicting = options.study == "prediction"
    known = tuple(LEARNERS) if predicting else (*PLANNABLE, *REFERENCES)
    for name in options.models:
        if name not in known:
            raise UnknownNameError.of("model", name, known)
    cells: list[Any] = []
    for domain in dict.fromkeys(options.domain):
        settings = get_domain(domain).settings
        require_known(options.population, "population", PEOPLE[domain].populations)
        chosen = options.setting or (settings if predicting else settings[-1:])
        models = options.models or tuple(
            name for name in known if name != "mirror-amortized" or _has_guide(domain)
        )
        seeds = range(options.seeds or (5 if predicting else 2))
        for setting in chosen:
            require_known(setting, "setting", settings)
            for model in models:
                for seed in seeds:
                    group = (domain, setting, options.population, options.people, seed, model)
                    if predicting:
                        cells.append(Prediction(*group, tuple(sorted({*options.rounds}))))
                        continue
                    numbers = (0,) if model in REFERENCES else sorted({*options.rounds})
                    if options.study == "relevance":
                        numbers = numbers[-1:]
                    cells += [
                        Assistance(*group, number, options.played, options.draws)
                        for number in numbers
                    ]
    order = {name: place for place, name in enumerate(known)}
    return sorted(cells, key=lambda cell: order[cell.model])


def _has_guide(domain: str) -> bool:
    from mirror_ppl.errors import AssetError
    from mirror_ppl.inference.guide_file import shipped_guide

    try:
        shipped_guide(domain)
    except AssetError:
        return False
    return True


def _identities(domains: Sequence[str]) -> Callable[[Any], str]:
    """What results of a cell depend on besides what is asked for: the weights, and the code."""
    import hashlib

    from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights

    digest, root = hashlib.sha256(), Path(__file__).parent
    for part in CODE:
        for path in sorted(root.glob(part)):
            digest.update(path.read_bytes())
    code = digest.hexdigest()
    weights = {
        name: fingerprint(load_self_model(shipped_weights(name), name)[0]) for name in {*domains}
    }
    return lambda cell: f"{code} {weights[cell.domain]}"


def _write_table(path: Path, rows: Rows) -> None:
    """As comma-separated values; columns that a row lacks stay empty."""
    columns = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows(rows)


def _prediction(rows: Rows) -> tuple[dict[str, Any], Picture]:
    from mirror_ppl.evaluation.study_summary import few_against_many, floors, summarize_study
    from mirror_ppl.plots.study import plot_curves

    standings, floor = summarize_study(rows, "nll", -1), floors(rows)
    claims = few_against_many(rows, "nll", -1)
    _show(standings, "NLL of held-out actions, nats an action: less is better", floor)
    for claim in claims:
        ahead, better = claim.paired.ahead, claim.paired.improvement
        print(
            f"{claim.place.domain}, {claim.place.setting}: mirror with {_counted(claim.rounds)} "
            f"against {claim.rival} with {_counted(claim.rival_rounds)}: ahead by {_text(ahead)} "
            f"nats, in {100 * better.mean:.0f}% of people"
        )
    data = {
        "nll": standings,
        "accuracy": summarize_study(rows, "accuracy"),
        "few_against_many": claims,
    }
    return data, plot_curves(standings, "NLL of held-out actions (nats an action)", floor)


def _assistance(rows: Rows) -> tuple[dict[str, Any], Picture]:
    from mirror_ppl.evaluation.study_summary import summarize_study
    from mirror_ppl.plots.study import plot_curves

    standings = summarize_study(rows, "net")
    _show(standings, "net return of a round: more is better", {})
    return {"net": standings}, plot_curves(standings, "net return of a round")


def _relevance(rows: Rows) -> tuple[dict[str, Any], Picture]:
    from mirror_ppl.domains import get_domain
    from mirror_ppl.evaluation.study_summary import relevance
    from mirror_ppl.plots.study import plot_relevance

    first, data = [], {}
    for name in dict.fromkeys(row["domain"] for row in rows):
        domain, own = get_domain(name), [row for row in rows if row["domain"] == name]
        for place, notion in enumerate(domain.relevance(_first_observation(domain))):
            found = relevance(own, notion, [m.name for m in domain.modalities])
            data[f"{name}: {notion}"] = found
            if not place:
                first.append(found)
            _show_shares(found, f"{name}: told items about {notion.replace('_', ' ')}")
    return {"relevance": data}, plot_relevance(first)


def _first_observation(domain: Domain) -> Observation:
    import torch

    return domain.observe(domain.initial(1, torch.Generator().manual_seed(0)))


def _effort(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Time that each part took, and what failed."""
    return {
        "seconds": {outcome.cell.label: round(outcome.seconds, 1) for outcome in outcomes},
        "failed": {
            outcome.cell.label: outcome.error for outcome in outcomes if outcome.error is not None
        },
    }


def _plain(value: Any) -> Any:
    """What JSON has no word for."""
    return str(value) if isinstance(value, Path) else asdict(value)


def _show(standings: Sequence[Standing], title: str, floor: Mapping[Place, float]) -> None:
    for place in dict.fromkeys(one.place for one in standings):
        here = [one for one in standings if one.place == place]
        numbers = sorted({one.rounds for one in here})
        by = {(one.model, one.rounds): one for one in here}
        caption = "by rounds learned from; in brackets how far mirror is ahead with the same rounds"
        if place in floor:
            caption += f"; people's own entropy: {floor[place]:.3f}"
        rows = [
            [model, *(_entry(by.get((model, number))) for number in numbers)]
            for model in dict.fromkeys(one.model for one in here)
        ]
        heads = ["model", *("-" if number == 0 else _counted(number) for number in numbers)]
        _print(f"{', '.join(place)}: {title}", caption, heads, rows)


def _entry(one: Standing | None) -> str:
    if one is None:
        return ""
    text = f"{one.measured.mean:.3f}"
    return text if one.mirror is None else f"{text}\n({_text(one.mirror.ahead)})"


def _show_shares(shares: Sequence[Share], title: str) -> None:
    names = list(dict.fromkeys(one.modality for one in shares))
    cells: dict[tuple[str, int], dict[str, str]] = {}
    for one in shares:
        text = "nothing told"
        if one.share is not None:
            low, high = 100 * one.share.low, 100 * one.share.high
            text = f"{100 * one.share.mean:.0f}% [{low:.0f}, {high:.0f}] of {one.items}"
        cells.setdefault((one.model, one.rounds), {})[one.modality] = text
    rows = [
        [model, "-" if rounds == 0 else str(rounds), *(own[name] for name in names)]
        for (model, rounds), own in cells.items()
    ]
    caption = "share that is relevant [90% interval over people] of the items told"
    _print(title, caption, ["model", "rounds", *names], rows)


def _text(one: Interval) -> str:
    return f"{one.mean:+.3f} [{one.low:+.3f}, {one.high:+.3f}]"


def _counted(number: int) -> str:
    return f"{number} round" + ("s" if number > 1 else "")


def _print(title: str, caption: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left")
    for row in rows:
        table.add_row(*row)
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    # Not by the table, which would make them as narrow as it is.
    console.print(title, style="italic", highlight=False)
    console.print(table, end="")
    console.print(f"({caption})\n", style="dim", highlight=False)


if __name__ == "__main__":
    raise SystemExit(run(Options, main, prog=PROGRAM, description=DESCRIPTION))

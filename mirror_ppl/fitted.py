"""A fit of several people, and one person of it: tables, pictures, files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirror_ppl.checks import whole_number
from mirror_ppl.communication.person import Person
from mirror_ppl.domains import require_known
from mirror_ppl.errors import InputError
from mirror_ppl.files import json_text, write_together
from mirror_ppl.inference.results import fitting
from mirror_ppl.inference.results.criticism import FINE, NLLS, SUSPECT, UNEXPLAINED
from mirror_ppl.inference.results.export import netcdf_content
from mirror_ppl.inference.weighted import HIGH_PARETO_K
from mirror_ppl.limits import LIMITS
from mirror_ppl.plots.fit import FILES, FitPlots
from mirror_ppl.timing import clocked, stage

if TYPE_CHECKING:
    import pandas as pd

RESULTS = ("summary.json", "posterior.nc", *FILES)
"""Names of all files that a fit may write."""


@dataclass(frozen=True, repr=False)
class Fit(fitting.Fit):
    """A fit of P people: the posterior, predictions and checks.

    Attributes:
        human: the human model.
        train: the training rounds.
        posterior: draws ``[S, P, 1, ...]`` by site, and how they were obtained.
        data: posterior, predictions and recordings as ArviZ ``InferenceData``.
        summary: the numbers that `summary.json` holds.
        seconds: processor seconds by stage.
    """

    def __repr__(self) -> str:
        told = self.summary
        doubtful = doubtful_people(told)
        warning = f"; weights not to be relied on: {', '.join(doubtful)}" if doubtful else ""
        for verdict in (SUSPECT, UNEXPLAINED):
            wrong = [one["id"] for one in told["people"] if one["check"]["verdict"] == verdict]
            warning += f"; {verdict}: {', '.join(wrong)}" if wrong else ""
        return (
            f"Fit({told['domain']}, {told['setting']}: {len(self.people)} people, "
            f"{told['guide']}, {len(next(iter(self.posterior.draws.values())))} draws{warning})"
        )

    @property
    def people(self) -> tuple[str, ...]:
        """Ids of the P people."""
        return self.train.people

    @cached_property
    def plot(self) -> FitPlots:
        """Figures of this fit, such as ``fit.plot.sight()``."""
        return FitPlots(self.data)

    @property
    def check(self) -> pd.DataFrame:
        """Model check, one row per person: verdict, reasons, held-out NLLs, p-values.

        ``nll`` (nats an action of held-out rounds) stands beside ``nll_base_rate`` (of the base
        rate of each action) and ``nll_no_implants`` (if the person were the robot);
        ``nll_left_out`` (of training rounds, each predicted from the others) stands beside that of
        the base rate in these. p-values are
        near 0 where there is more of something than the model predicts, near 1 where there is less.
        With the human model ``all``, ``p(<model>)`` are the probabilities of its models.
        """
        import pandas as pd

        rows = []
        for person in self.summary["people"]:
            told = dict(person["check"])
            rows.append(
                {"verdict": told.pop("verdict"), "reasons": "; ".join(told.pop("reasons"))}
                | {"nll": (person["test"] or {}).get("nll")}
                | {name: told[name] for name in NLLS}
                | {f"p({name})": value for name, value in told.get("models", {}).items()}
                | told["p_values"]
            )
        table = pd.DataFrame(rows, index=pd.Index(self.people, name="person"))
        return table.astype(dict.fromkeys(("nll", *NLLS), float))  # NaN without such rounds

    def person(self, name: str | None = None) -> FittedPerson:
        """Select one of the people; the only one unless named.

        Raises:
            UnknownNameError: no person has that id.
            InputError: there are several people, and none is named.
        """
        return FittedPerson(self, one_of(self.people, name, "the fit"))

    def save(self, folder: str | Path, **told: Any) -> dict[str, str]:
        """Write ``posterior.nc``, ``summary.json`` and the pictures, all of them or none.

        Args:
            folder: the folder; files of an older fit are replaced.
            told: additional entries of ``summary.json``.

        Returns:
            Descriptions of the pictures, by file name.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        with clocked() as seconds:
            with stage("draw"):
                descriptions, drawn = {}, {}
                for name, picture, shows in self.plot.files():
                    descriptions[name], drawn[name] = shows, picture.content()
                    del picture  # one at a time is in memory
            with stage("write"):
                posterior = netcdf_content(self.data)
        spent = {name: round(each, 2) for name, each in (self.seconds | seconds).items()}
        summary = self.summary | told | {"processor_seconds": spent}
        contents = {
            folder / "posterior.nc": posterior,
            **{folder / name: content for name, content in drawn.items()},
            folder / "summary.json": json_text(summary),
        }
        # Files of an older fit go first: it may have drawn pictures that this one does not, and
        # without a summary the results of a fit that is killed here do not look complete.
        write_together(contents, remove=[folder / name for name in RESULTS])
        return descriptions


@dataclass(frozen=True)
class FittedPerson:
    """One person of a fit.

    Attributes:
        fit: the fit.
        name: id of the person.
    """

    fit: Fit
    name: str

    def __repr__(self) -> str:
        doubtful = self.name in doubtful_people(self.fit.summary)
        warning = "; weights not to be relied on" if doubtful else ""
        check = self.summary["check"]
        if check["verdict"] not in FINE:
            warning += f"; {check['verdict']}: {'; '.join(check['reasons'])}"
        return f"FittedPerson({self.name}: {self.summary['rounds']} rounds{warning})"

    @property
    def number(self) -> int:
        """Index of the person in the fit, from 0."""
        return self.fit.people.index(self.name)

    @property
    def summary(self) -> dict[str, Any]:
        """The person's part of the fit's summary."""
        return self.fit.summary["people"][self.number]

    @property
    def implants(self) -> pd.DataFrame:
        """Median, 90% interval and truth (if known) of each implant that is one number."""
        import pandas as pd

        return pd.DataFrame(self.summary["implants"]).T

    @property
    def draws(self) -> dict[str, Any]:
        """Posterior draws ``[S, 1, 1, ...]`` by site, tensors."""
        own = slice(self.number, self.number + 1)
        return {name: value[:, own] for name, value in self.fit.posterior.draws.items()}

    def listener(self, draws: int = 64) -> Person:
        """Make the person to plan messages for, with ``draws`` evenly spaced posterior draws."""
        held = len(next(iter(self.fit.posterior.draws.values())))
        number = min(whole_number(draws, "draws", *LIMITS["draws"]), held)
        chosen = [round(place * (held - 1) / max(number - 1, 1)) for place in range(number)]
        return Person(self.fit.human, {name: value[chosen] for name, value in self.draws.items()})


def one_of(people: tuple[str, ...], name: str | None, where: str) -> str:
    """Id of a person; that of the only one unless named."""
    if name is None and len(people) > 1:
        raise InputError(
            f"{where} is of {len(people)} people: name one of them, such as {next(iter(people))!r}"
        )
    return require_known(next(iter(people)) if name is None else name, "person", people)


def doubtful_people(summary: Mapping[str, Any]) -> list[str]:
    """Ids of people whose importance weights are not reliable."""
    return [
        person["id"]
        for person in summary["people"]
        if (person.get("pareto_k") or 0.0) > HIGH_PARETO_K
    ]

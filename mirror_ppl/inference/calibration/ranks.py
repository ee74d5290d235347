"""Ranks of the truth among posterior draws, and statistics of calibration.

If people are drawn from the prior, their actions from the program, and inference is exact, the
truth is exchangeable with its S posterior draws: its rank among them is uniform over 0 .. S.
Posteriors that are too narrow give too many extreme ranks, too wide ones too few, and shifted ones
too many at one end. The prior, or a posterior that ignores part of the data, is calibrated, too:
``contraction`` measures how much is inferred. This module does not depend on the source of draws.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.stats import entropy

from mirror_ppl.errors import InputError, PosteriorError
from mirror_ppl.files import write_whole
from mirror_ppl.inference.calibration.uniformity import ecdf_p_value, histogram_p_value
from mirror_ppl.inference.weighted import HIGH_PARETO_K
from mirror_ppl.netcdf import read_netcdf

FAILURE_RATE = 1e-3
"""Probability that a calibrated posterior is rejected, for each site and number of rounds."""
LEVELS = (0.5, 0.8, 0.9)
"""Probabilities of the central intervals whose coverage is counted."""
ENDS = (0.05, 0.95)
"""Quantiles at the ends of the interval whose width is measured."""
EXACTLY: Any = {
    "join": "exact",
    "combine_attrs": "override",
    "data_vars": "all",
    "coords": "minimal",
}
"""Options for joining parts, which have to match."""


@dataclass(frozen=True)
class Calibration:
    """Results of a calibration, for each site and number of rounds.

    Attributes:
        data: dimensions ``site``, ``rounds`` and ``person``, variables of :func:`judge` and
            :func:`collect`; attributes describe what was calibrated.
        failure_rate: probability that a calibrated posterior is rejected, for each site and number
            of rounds.

    Raises:
        InputError: the failure rate is no probability.
    """

    data: xr.Dataset
    failure_rate: float = FAILURE_RATE

    def __post_init__(self) -> None:
        if not 0 < self.failure_rate < 1:
            raise InputError(f"failure_rate must be between 0 and 1, not {self.failure_rate}")

    @property
    def people(self) -> int:
        """Number of people P."""
        return self.data.sizes["person"]

    @property
    def draws(self) -> int:
        """Number of posterior draws S of each person."""
        return int(self.data.attrs["draws"])

    @property
    def coverage(self) -> xr.DataArray:
        """Share of people whose central interval holds the truth, ``[site, rounds, level]``.

        S draws leave S + 1 gaps, equally probable to hold the truth. ``place`` is a random point of
        the truth's gap, so it is uniform over 0 .. 1 if the posterior is calibrated; and the
        interval of level q holds the truth if ``|2 place - 1| <= q``, which has probability q
        exactly. An interval that ends inside of a gap, or inside of the probability of one value of
        a discrete site, is thus randomized.
        """
        level = xr.DataArray(list(LEVELS), coords={"level": list(LEVELS)}, dims="level")
        inside = abs(2 * self.data["place"] - 1) <= level
        return inside.mean("person")

    @property
    def coverage_error(self) -> xr.DataArray:
        """Binomial standard errors of the coverage, under a flat prior and so never 0."""
        share = (self.coverage * self.people + 1) / (self.people + 2)
        return (share * (1 - share) / (self.people + 3)) ** 0.5

    @property
    def rejected(self) -> list[tuple[str, int]]:
        """Sites and numbers of rounds whose calibration is rejected."""
        table = self.table()
        wrong = table[table["p_value"] < self.failure_rate]
        return list(zip(wrong["site"].tolist(), wrong["rounds"].tolist(), strict=True))

    def table(self) -> pd.DataFrame:
        """One row for each site and number of rounds.

        Returns:
            - ``site``, ``rounds``;
            - ``p_value`` of uniform ranks, by two tests at once: twice the smaller of
              ``p_histogram`` and ``p_ecdf``, or the latter alone where the former is NaN because
              people are too few;
            - ``coverage_50``, ``coverage_50_se`` and so on: :attr:`coverage` with its error;
            - ``contraction`` of the posterior: 0 for the prior, 1 for certainty. One less the mean
              width of the 90% interval, relative to the prior's; for discrete sites one less the
              mean entropy, relative to the prior's;
            - for discrete sites (else NaN) ``probability``, the posterior's of the truth, and
              ``entropy`` in nats, both means, and ``prior_probability`` and ``prior_entropy``;
            - ``high_pareto_k``: share of people above 0.7; NaN if there are no weights.
        """
        data = self.data.assign(coverage=self.coverage, error=self.coverage_error)
        pairs = itertools.product(data["site"].values.tolist(), data["rounds"].values.tolist())
        rows = [
            {"site": site, "rounds": rounds} | self._row(data.sel(site=site, rounds=rounds))
            for site, rounds in pairs
        ]
        return pd.DataFrame(rows)

    def _row(self, own: xr.Dataset) -> dict[str, Any]:
        rank = own["rank"].values
        tests = {
            "p_histogram": histogram_p_value(rank, self.draws),
            "p_ecdf": ecdf_p_value(rank, self.draws),
        }
        known = [value for value in tests.values() if not np.isnan(value)]
        row: dict[str, Any] = {"p_value": min(1.0, len(known) * min(known))} | tests
        for level in LEVELS:
            name = f"coverage_{round(100 * level)}"
            row[name] = float(own["coverage"].sel(level=level))
            row[f"{name}_se"] = float(own["error"].sel(level=level))
        kind = "entropy" if own["discrete"] else "width"
        before = float(own[f"prior_{kind}"])
        # Undefined for a site that is certain under the prior.
        row["contraction"] = 1 - float(own[kind].mean()) / before if before > 0 else np.nan
        for name in ("probability", "entropy"):
            row[name] = float(own[name].mean())
            row[f"prior_{name}"] = float(own[f"prior_{name}"])
        weights = own["pareto_k"].values
        row["high_pareto_k"] = np.where(np.isnan(weights), np.nan, weights > HIGH_PARETO_K).mean()
        return row

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write netCDF, whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        write_whole(path, self.content())

    def content(self) -> memoryview:
        """Content of its netCDF file."""
        data = self.data.assign_attrs(failure_rate=self.failure_rate)
        return data.to_netcdf(engine="h5netcdf")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Read a file written by :meth:`save`.

        Raises:
            PosteriorError: the file is missing or damaged, or holds something else.
        """
        data = read_netcdf(path, PosteriorError)["/"]
        try:
            calibration = cls(data, float(data.attrs.pop("failure_rate")))
            calibration.table()  # reads everything that has to be there
        except Exception as error:
            raise PosteriorError(f"{path}: cannot be read as a calibration ({error})") from error
        return calibration


def ranks(truth: np.ndarray, draws: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ranks ``[P]``, from 0 to S, of truths ``[P]`` among draws ``[S, P]``.

    Ties are broken uniformly at random. If the truth is exchangeable with the draws, all S + 1
    ranks are thus equally probable, also with ties.
    """
    below, same = (draws < truth).sum(0), (draws == truth).sum(0)
    return below + rng.integers(same + 1)


def judge(
    truth: Mapping[str, np.ndarray],
    draws: Mapping[str, np.ndarray],
    discrete: Collection[str],
    rng: np.random.Generator,
    pareto_k: np.ndarray | None = None,
) -> xr.Dataset:
    """Compare posterior draws with the truth.

    Args:
        truth: by site, ``[P]``.
        draws: by site, ``[S, P]``.
        discrete: names of the discrete sites.
        rng: source of randomness for ties.
        pareto_k: Pareto k of importance weights ``[P]``; NaN counts as infinite.

    Returns:
        Dimensions ``site`` and ``person``: ``truth``; its ``rank``; its ``place``, see
        :attr:`Calibration.coverage`; ``width`` of the 90% interval of continuous sites;
        ``probability`` of the truth and ``entropy`` in nats of discrete sites, from shares of draws
        (which biases the entropy of n values by up to ``-(n - 1) / 2S``). ``pareto_k`` has the
        dimension ``person`` only.

    Raises:
        InputError: there are no draws, or their number differs between sites.
    """
    sizes = {len(draws[site]) for site in truth}
    if len(sizes) != 1 or 0 in sizes:
        raise InputError(f"expected as many draws of each site, and some, not {sorted(sizes)}")
    measured = []
    for site, true in truth.items():
        own = draws[site]
        rank = ranks(true, own, rng)
        place = (rank + rng.random(len(rank))) / (len(own) + 1)
        probability = (own == true).mean(0) if site in discrete else np.full(len(true), np.nan)
        one = {"truth": true, "rank": rank, "place": place, "probability": probability}
        measured.append(one | _spread(own, site in discrete))
    number = len(measured[0]["truth"])
    weights = np.full(number, np.nan)
    if pareto_k is not None:
        weights = np.where(np.isnan(pareto_k), np.inf, pareto_k)
    return xr.Dataset(
        {
            name: (("site", "person"), np.stack([one[name] for one in measured]))
            for name in measured[0]
        }
        | {"pareto_k": ("person", weights)},
        coords={"site": list(truth)},
        attrs={"draws": sizes.pop()},
    )


def join_rounds(judged: Mapping[int, xr.Dataset]) -> xr.Dataset:
    """Join results for the same people after several numbers of rounds along ``rounds``.

    Raises:
        InputError: numbers of draws differ.
    """
    return _joined(list(judged.values()), pd.Index(list(judged), name="rounds"))


def collect(
    parts: Sequence[xr.Dataset],
    prior: Mapping[str, np.ndarray],
    discrete: Collection[str],
    attributes: Mapping[str, str],
) -> Calibration:
    """Join results for all people, and add statistics of the prior.

    Args:
        parts: results of :func:`join_rounds` for some people each.
        prior: draws of the prior by site, ``[D]``.
        discrete: names of the discrete sites.
        attributes: attributes of the file.

    Returns:
        Variables of :func:`judge`, with the dimension ``rounds`` in between (except ``truth``); and
        by site ``discrete``, ``prior_width``, ``prior_entropy`` and ``prior_probability``, the mean
        prior probability of the truth.

    Raises:
        InputError: numbers of draws differ.
    """
    data = _joined(parts, "person").transpose("site", "rounds", "person")
    data["truth"] = data["truth"].isel(rounds=0, drop=True)
    before = {site: _of_prior(prior[site], site in discrete) for site in prior}
    for name in next(iter(before.values())):
        values = [before[site][name] for site in data["site"].values.tolist()]
        data[name] = ("site", np.asarray(values))
    return Calibration(data.assign_attrs(attributes))


def _joined(parts: Sequence[xr.Dataset], dimension: str | pd.Index) -> xr.Dataset:
    sizes = {part.attrs["draws"] for part in parts}
    if len(sizes) != 1:
        raise InputError(f"expected as many draws every time, not {sorted(sizes)}")
    return xr.concat(parts, dimension, **EXACTLY)


def _of_prior(values: np.ndarray, discrete: bool) -> dict[str, float]:
    """Statistics of the prior for :func:`collect`, from draws ``[D]``."""
    _, counts = np.unique(values, return_counts=True)
    probability = float(((counts / len(values)) ** 2).sum()) if discrete else np.nan
    spread = {name: float(part[0]) for name, part in _spread(values[:, None], discrete).items()}
    return {
        "discrete": float(discrete),
        "prior_width": spread["width"],
        "prior_entropy": spread["entropy"],
        "prior_probability": probability,
    }


def _spread(values: np.ndarray, discrete: bool) -> dict[str, np.ndarray]:
    """Width of the 90% interval or entropy ``[P]`` of draws ``[S, P]``; the other is NaN."""
    unknown = np.full(values.shape[1], np.nan)
    if discrete:
        shares = np.stack([(values == value).mean(0) for value in np.unique(values)])
        return {"width": unknown, "entropy": np.asarray(entropy(shares))}
    low, high = np.quantile(values, ENDS, axis=0)
    return {"width": high - low, "entropy": unknown}

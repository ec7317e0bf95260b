"""The report of a comparison in one environment, for a reader who did not run it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_env_bimanual.disturbances import NOMINAL, parse_condition
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.report import pages
from tpgmm_evaluation.report.failures import criterion, evaluation_command
from tpgmm_evaluation.report.tables import cell_table, episode_table
from tpgmm_evaluation.settings import Settings

__all__ = ["write_report"]


def write_report(
    out: Path,
    settings: Settings,
    results: Sequence[Mapping[str, Any]],
    failures: Mapping[Cell, str],
) -> Path:
    """Write ``report.md``.

    Parameters
    ----------
    out : Path
        The folder of the environment.
    results : sequence of mapping
        Of all finished cells.
    failures : mapping
        Cells that failed, with the reason.

    Returns
    -------
    Path
        The report.
    """
    out.mkdir(parents=True, exist_ok=True)
    paragraphs = [f"# What demonstrations buy: {settings.env}"]
    if results:
        paragraphs += _Sections(settings, results)
    paragraphs += pages.failed_cells("Cells that failed", failures)
    return pages.write_page(out / "report.md", paragraphs)


class _Sections:
    """Paragraphs of a comparison in one environment, in Markdown.

    Parameters
    ----------
    results : sequence of mapping
        Of all finished cells.
    """

    def __init__(self, settings: Settings, results: Sequence[Mapping[str, Any]]) -> None:
        self.settings, self.results = settings, results
        self.cells, self.episodes = cell_table(results), episode_table(results)
        episodes, cells = self.episodes, self.cells
        self.nominal = episodes[episodes.condition == NOMINAL]
        self.benchmark = settings.benchmark()
        self.policies = pages.ordered(cells.policy)
        self.counts = sorted(set(cells.demonstrations))
        self.trainings = {
            (r["cell"]["policy"], r["cell"]["demonstrations"], r["cell"]["seed"]): r["training"]
            for r in results
        }

    def __iter__(self) -> Iterator[str]:
        yield from self._introduction()
        if len(self.nominal):
            yield from self._criteria()
            yield from self._errors()
        yield from self._conditions()
        yield from self._baselines()
        yield from self._recipes()
        yield "## What to keep in mind"
        yield pages.bullets(self._remarks())
        yield from self._settings()

    def _introduction(self) -> Iterator[str]:
        seeds, counts = self.settings.seeds, pages.listed(self.counts)
        yield (
            f"Every policy learned from the same first {counts} recorded episodes of "
            f"`{self.benchmark.env}` ({self._drawn()}) and was rolled out, through LeRobot's "
            f"own rollout, in the same {len(seeds)} situations that no episode shows (seeds "
            f"{seeds[0]} to {seeds[-1]})."
        )
        yield pages.bullets(f"**{name}**: {pages.described(name)}" for name in self.policies)

    def _drawn(self) -> str:
        """Which demonstrations they are."""
        seed = self.settings.demonstration_seed
        if seed is not None:
            return f"the LeRobot data set `episodes/s{seed}/training`"
        return "the LeRobot data sets `episodes/sS/training`, another draw for each seed S"

    def _conditions(self) -> Iterator[str]:
        """Everything beside the nominal condition, in one table for each number."""
        known = self.benchmark.all_conditions
        found = set(self.cells.condition)
        others = sorted(found - set(known), key=lambda name: (name.count("+"), name))
        conditions = [name for name in (*known, *others) if name in found]
        if conditions in ([], [NOMINAL]):
            return
        yield "## Conditions"
        yield (
            "Successful episodes with the 95 % interval of their share (Wilson), and median / "
            "95th percentile of the figures over the episodes. Every condition has the same "
            "situations; the moments of what goes wrong are drawn from the episode's seed."
        )
        yield pages.bullets(f"`{name}`: {self._described(name)}" for name in conditions)
        figures = pages.known(self.benchmark.figures, self.episodes)
        for count, part in self.episodes.groupby("demonstrations"):
            yield f"From {count} demonstrations:"
            groups = (
                ([condition, policy, pages.rate(rows)], rows)
                for condition in conditions
                for policy, rows in pages.by_policy(part[part.condition == condition])
            )
            yield pages.figure_table(["condition", "policy", "success"], groups, figures)

    def _described(self, condition: str) -> str:
        """What goes wrong, in the words of those who make it go wrong."""
        if condition == NOMINAL:
            return "nothing goes wrong."
        told = []
        for name in condition.split("+"):
            if name in self.benchmark.disturbances:
                told.append(f"`{json.dumps(self.benchmark.disturbances[name])}`.")
            else:
                [disturbance] = parse_condition(name)
                told.append(str(type(disturbance).__doc__).partition("\n")[0])
        return " ".join(told)

    def _criteria(self) -> Iterator[str]:
        """Which part of the skill fails."""
        criteria = self.benchmark.criteria
        if not criteria.keys() <= set(self.nominal.columns):
            return
        most = self.nominal.demonstrations.max()
        yield "## What succeeds and what fails"
        yield f"Share of the episodes that meet each criterion, {most} demonstrations."
        table = []
        for policy, rows in pages.by_policy(self.nominal[self.nominal.demonstrations == most]):
            met = (rows[key].between(f.low, f.high).mean() for key, f in criteria.items())
            table.append([policy, *(f"{100 * share:.0f} %" for share in met)])
        yield pages.table(
            ["policy", *(criterion(self.benchmark, key) for key in criteria)], table
        )

    def _errors(self) -> Iterator[str]:
        figures = pages.known(self.benchmark.figures, self.nominal)
        yield "## Errors"
        yield "Median / 95th percentile over the episodes, nominal condition."
        groups = (
            ([count, policy], rows)
            for count, part in self.nominal.groupby("demonstrations")
            for policy, rows in pages.by_policy(part)
        )
        yield pages.figure_table(["demonstrations", "policy"], groups, figures)

    def _baselines(self) -> Iterator[str]:
        trained = {key: item for key, item in self.trainings.items() if item["curve"]}
        if not trained:
            return
        recipes = {policy: item["recipe"] for (policy, _, _), item in trained.items()}
        yield "## How the baselines were trained"
        yield (
            f"Every {next(iter(recipes.values()))['check_every']} steps the moving average of "
            f"the weights is tried on {self.settings.validation} held-out episodes that no "
            "policy learns from: the error of the actions is the mean distance between "
            "predicted and demonstrated joint references over the steps that are executed "
            "before the next prediction. When it has not fallen by 1 % for some checks, the "
            "learning rate falls to a third (it also does towards the end of the budget); when "
            f"that no longer helps, or {self.settings.budget / 60:g} minutes of one processor "
            "are used up, training ends. The weights of the least error are the ones evaluated."
        )
        rows = []
        for key, item in trained.items():
            curve = item["curve"]
            best = min(curve, key=lambda point: point["validation_error"])
            minutes, error = curve[-1]["seconds"] / 60, 1e3 * best["validation_error"]
            steps, at = curve[-1]["step"], best["step"]
            rows.append([*key, steps, f"{minutes:.1f}", f"{error:.2f}", at, item["outcome"]])
        columns = ("steps", "minutes", "least error [mrad]", "at step", "why it ended")
        yield pages.table(["policy", "demonstrations", "seed", *columns], rows)

    def _recipes(self) -> Iterator[str]:
        """Everything that was chosen for a policy, and what it found in the demonstrations."""
        recipes = {p: item["recipe"] for (p, _, _), item in self.trainings.items()}
        told = [f"{p}: `{json.dumps(recipes[p])}`" for p in self.policies if recipes.get(p)]
        if told:
            yield "## Recipes"
            yield pages.bullets(told)

    def _remarks(self) -> Iterator[str]:
        """What the data say about themselves."""
        ended = [
            f"{policy} ({count}: the error fell by {100 * _late_gain(item['curve']):.0f} %)"
            for (policy, count, _), item in self.trainings.items()
            if "budget" in item["outcome"]
        ]
        if ended:
            yield (
                f"The budget ended the training of {', '.join(ended)}; in brackets what the "
                "last third of the steps brought. Where that is much, more time may help."
            )
        processors = {result["machine"]["processors"] for result in self.results}
        yield (
            "Latencies were measured while other cells ran beside, on a machine of "
            f"{pages.listed(processors)} processors; compare them with one another, not "
            "with a robot's computer."
        )

    def _settings(self) -> Iterator[str]:
        yield "## Settings"
        settings = asdict(self.settings)
        rows = [[key.replace("_", " "), f"`{json.dumps(v)}`"] for key, v in settings.items()]
        rows.append(["training seeds", pages.listed(set(self.cells.seed))])
        for name in ("versions", "machine"):
            distinct = sorted({json.dumps(item[name]) for item in self.results})
            rows += [[name, f"`{text}`"] for text in distinct]
        yield pages.table(["setting", "value"], rows)
        yield (
            "`policies/` holds what was trained; all but `nearest` run in LeRobot's own "
            "evaluation, at the rate of the table above:"
        )
        trials, first = self.settings.episodes, self.settings.seeds[0]
        command = evaluation_command(
            self.settings, NOMINAL, "policies/NAME", "RATE", first, trials
        )
        yield pages.block([command])


def _late_gain(curve: Sequence[Mapping[str, float]]) -> float:
    """By which share the least error fell in the last third of a training."""
    errors = [point["validation_error"] for point in curve]
    return 1 - min(errors) / min(errors[: max(1, 2 * len(errors) // 3)])

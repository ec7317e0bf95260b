"""The report of a comparison in one environment, for a reader who did not run it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_env_bimanual.disturbances import NOMINAL, parse_condition
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.jobs import POLICIES
from tpgmm_evaluation.report import markdown
from tpgmm_evaluation.report.failures import criterion, evaluation_command
from tpgmm_evaluation.report.figures import (
    draw_curves,
    draw_errors,
    draw_success,
)
from tpgmm_evaluation.report.tables import (
    cell_table,
    demonstration_table,
    episode_table,
    wilson,
)
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import EVEN_CLOCK, OPEN_LOOP, Variant
from tpgmm_torch.atomic import replacing

__all__ = ["ordered", "write_report"]

#: What each policy is, in the order of the report.
DESCRIPTIONS = {
    "tpgmm": "task-parameterised Gaussian mixture: the hands' poses seen from the objects, "
    "and the joints",
    OPEN_LOOP: "the same, played by the clock with what is seen at the start, as in 0.1.0",
    EVEN_CLOCK: "the same, watching the scene, but by the clock, wherever the robot is",
    "tpgmm-places": "the same, learned and played with all objects as places: where they were "
    "at the beginning, whoever holds them later",
    "tpgmm-position-only": "the same without the orientation of the hands",
    "tpgmm-no-joints": "the same without the joints as a subspace: the hands' poses alone",
    "tpgmm-auto": "the same with the subspaces chosen by itself, operators='auto'",
    "key-poses": "inverse kinematics to the hands' key poses, each seen from where "
    "demonstrations differ least, along minimum-jerk paths with the mean timing",
    "key-poses-posture": "the same with the mean demonstrated posture in the null space",
    "dmp": "dynamical movement primitives of the joints, one for each move, whose goals are "
    "the key poses by inverse kinematics",
    "promp": "a probabilistic movement primitive of the joints, conditioned on the present "
    "posture and on the key poses by inverse kinematics",
    "act": "LeRobot's Action Chunking Transformer on joints and object poses",
    "act-phase": "the same, informed of the time and learning from episodes on a common clock",
    "act-large": "it again, with LeRobot's own sizes: forty million weights",
    "act-large-phase": "the same, informed of the time and learning from episodes on a common "
    "clock",
    "diffusion": "LeRobot's Diffusion Policy on joints and object poses",
    "diffusion-phase": "the same, informed of the time and learning from episodes on a common "
    "clock",
    "mlp": "a perceptron on joints and object poses, which predicts the next actions",
    "mlp-phase": "the same, informed of the time and learning from episodes on a common clock",
    "knn": "nearest-neighbour regression on joints and object poses to the next actions",
    "knn-phase": "the same, informed of the time and learning from episodes on a common clock",
    "nearest": "replays the demonstration whose objects stood nearest: the naive floor",
    "mean": "replays the mean of the aligned demonstrations, wherever the objects are",
}


def write_report(
    out: Path,
    settings: Settings,
    results: Sequence[Mapping[str, Any]],
    failures: Mapping[Cell, str],
) -> Path:
    """Write tables, figures and ``report.md``.

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
        cells, episodes = cell_table(results), episode_table(results)
        paragraphs += _Sections(out, settings, results, cells, episodes)
    if failures:
        reasons = [f"- `{cell.key}`: {reason}" for cell, reason in failures.items()]
        paragraphs += ["## Cells that failed", "\n".join(reasons)]
    path = out / "report.md"
    with replacing(path) as file:
        file.write_text("\n\n".join(paragraphs) + "\n", encoding="utf-8")
    return path


class _Sections:
    """Text and pictures of a comparison: its paragraphs, in Markdown.

    Parameters
    ----------
    out : Path
        Where pictures go, in the folder ``figures``.
    results : sequence of mapping
        Of all finished cells.
    cells, episodes : DataFrame
        The same as tables.
    """

    def __init__(
        self,
        out: Path,
        settings: Settings,
        results: Sequence[Mapping[str, Any]],
        cells: pd.DataFrame,
        episodes: pd.DataFrame,
    ) -> None:
        self.out, self.settings, self.results = out, settings, results
        self.cells, self.episodes = cells, episodes
        self.nominal = episodes[episodes.condition == NOMINAL]
        self.benchmark = settings.benchmark()
        self.policies = ordered(cells.policy)
        self.counts = sorted(set(cells.demonstrations))
        self.trainings = {
            (r["cell"]["policy"], r["cell"]["demonstrations"], r["cell"]["seed"]): r["training"]
            for r in results
        }

    def __iter__(self) -> Iterator[str]:
        yield from self._introduction()
        if len(self.nominal):
            yield from self._success()
            yield from self._criteria()
            yield from self._errors()
        yield from self._conditions()
        yield from self._baselines()
        yield from self._recipes()
        yield from self._cost()
        yield "## What to keep in mind"
        yield "\n".join(f"- {text}" for text in self._remarks())
        yield from self._settings()

    def _introduction(self) -> Iterator[str]:
        seeds, counts = self.settings.seeds, markdown.listed(self.counts)
        yield (
            f"Every policy learned from the same first {counts} recorded episodes of "
            f"`{self.benchmark.env}` ({self._drawn()}) and was rolled out, through LeRobot's "
            f"own rollout, in the same {len(seeds)} situations that no episode shows (seeds "
            f"{seeds[0]} to {seeds[-1]})."
        )
        yield "\n".join(f"- **{name}**: {_description(name)}" for name in self.policies)

    def _drawn(self) -> str:
        """Which demonstrations they are."""
        seed = self.settings.demonstration_seed
        if seed is not None:
            return f"the LeRobot data set `episodes/s{seed}/training`"
        return "the LeRobot data sets `episodes/sS/training`, another draw for each seed S"

    def _success(self) -> Iterator[str]:
        yield "## Success"
        yield "Successful episodes, and the 95 % interval of their share (Wilson)."
        # policies down, numbers of demonstrations across
        yield markdown.table(
            ["policy", *(f"{count} demonstrations" for count in self.counts)],
            [
                [policy, *(markdown.rate(rows[rows.demonstrations == n]) for n in self.counts)]
                for policy, rows in self._by_policy(self.nominal)
            ],
        )
        if self.nominal.policy.nunique() > 1:
            draw_success(self.nominal, self._picture("success_nominal"))
            yield "![Success over demonstrations](figures/success_nominal.webp)"

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
        yield "\n".join(f"- `{name}`: {self._described(name)}" for name in conditions)
        figures = {k: v for k, v in self.benchmark.figures.items() if k in self.episodes}
        headings = ["condition", "policy", "success", *(name for name, _ in figures.values())]
        for count, part in self.episodes.groupby("demonstrations"):
            yield f"From {count} demonstrations:"
            table = []
            for condition in conditions:
                chosen = part[part.condition == condition]
                for policy, rows in self._by_policy(chosen):
                    spreads = [
                        markdown.spread(rows[k], digits) for k, (_, digits) in figures.items()
                    ]
                    table.append([condition, policy, markdown.rate(rows), *spreads])
            yield markdown.table(headings, table)

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
        for policy, rows in self._by_policy(self.nominal[self.nominal.demonstrations == most]):
            met = [rows[key].between(*bounds).mean() for key, bounds in criteria.items()]
            table.append([policy, *(f"{100 * share:.0f} %" for share in met)])
        yield markdown.table(
            ["policy", *(criterion(self.benchmark, key) for key in criteria)], table
        )

    def _errors(self) -> Iterator[str]:
        figures = {k: v for k, v in self.benchmark.figures.items() if k in self.nominal}
        yield "## Errors"
        yield "Median / 95th percentile over the episodes, nominal condition."
        table = []
        for count, part in self.nominal.groupby("demonstrations"):
            for policy, rows in self._by_policy(part):
                spreads = [
                    markdown.spread(rows[key], digits) for key, (_, digits) in figures.items()
                ]
                table.append([count, policy, *spreads])
        headings = (heading for heading, _ in figures.values())
        yield markdown.table(["demonstrations", "policy", *headings], table)
        draw_errors(self.nominal, figures, self.benchmark.criteria, self._picture("errors"))
        yield "Dotted: what a success allows."
        yield "![Median and quartiles of the errors](figures/errors.webp)"

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
        yield markdown.table(["policy", "demonstrations", "seed", *columns], rows)
        draw_curves(
            [
                {"policy": p, "demonstrations": n, "seed": s, "curve": item["curve"]}
                for (p, n, s), item in trained.items()
            ],
            self._picture("learning_curves"),
        )
        yield "![Learning curves](figures/learning_curves.webp)"

    def _recipes(self) -> Iterator[str]:
        """Everything that was chosen for a policy, and what it found in the demonstrations."""
        recipes = {p: item["recipe"] for (p, _, _), item in self.trainings.items()}
        told = [f"- {p}: `{json.dumps(recipes[p])}`" for p in self.policies if recipes.get(p)]
        if told:
            yield "## Recipes"
            yield "\n".join(told)

    def _cost(self) -> Iterator[str]:
        yield "## What it costs"
        yield (
            "With the most demonstrations. An action is everything from the raw observation to "
            "the joint references for one robot, on one thread; policies that predict chunks "
            "compute one every so many steps and take its actions from memory in between."
        )
        columns = (
            "policy",
            "training [s]",
            "parameters",
            "on disk [MB]",
            "rate [Hz]",
            "step, median / 99 % [ms]",
            "steps per chunk",
            "chunk, median / 99 % [ms]",
            "evaluation, CPU [s/episode]",
        )
        rows = self.cells.sort_values("demonstrations").groupby("policy").tail(1)
        yield markdown.table(
            columns,
            [
                [
                    row.policy,
                    f"{row.training_seconds:.0f}",
                    f"{row.parameters:,}".replace(",", " "),
                    f"{row.bytes / 1e6:.1f}",
                    row.fps,
                    f"{row.step_median_ms:.2f} / {row.step_p99_ms:.2f}",
                    f"{row.chunk_size:.0f}",
                    f"{row.chunk_median_ms:.2f} / {row.chunk_p99_ms:.2f}",
                    f"{row.evaluation_cpu_seconds / row.episodes:.2f}",
                ]
                for _, part in self._by_policy(rows)
                for row in part.itertuples()
            ],
        )

    def _remarks(self) -> Iterator[str]:
        """What the data say about themselves."""
        for row in demonstration_table(self.out).itertuples():
            yield (
                f"By the environment's own criteria {row.succeed} of {row.tried} attempts at "
                f"demonstrations of seed {row.seed} succeed; the others are not learned from."
            )
        trials = self.settings.episodes
        low, high = wilson(trials // 2, trials)
        yield (
            f"With {trials} episodes a rate around one half is known to "
            f"{50 * (high - low):.0f} percentage points, either way."
        )
        seeds = self.cells.seed.nunique()
        if seeds == 1:
            yield (
                "Each policy was trained with one seed: the intervals say how much the choice "
                "of situations matters, not how much other demonstrations or another training "
                "would change."
            )
        else:
            yield (
                f"Episodes of {seeds} training seeds are taken together; the intervals treat "
                "them as independent, which episodes of one training are not quite: look at "
                "the dots of the figure too."
            )
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
            f"{markdown.listed(processors)} processors; compare them with one another, not "
            "with a robot's computer."
        )

    def _settings(self) -> Iterator[str]:
        yield "## Settings"
        settings = asdict(self.settings)
        rows = [[key.replace("_", " "), f"`{json.dumps(v)}`"] for key, v in settings.items()]
        rows.append(["training seeds", markdown.listed(set(self.cells.seed))])
        for name in ("versions", "machine"):
            distinct = sorted({json.dumps(item[name]) for item in self.results})
            rows += [[name, f"`{text}`"] for text in distinct]
        yield markdown.table(["setting", "value"], rows)
        yield (
            "`policies/` holds what was trained; all but `nearest` run in LeRobot's own "
            "evaluation, at the rate of the table above:"
        )
        trials, first = self.settings.episodes, self.settings.seeds[0]
        command = evaluation_command(
            self.settings, NOMINAL, "policies/NAME", "RATE", first, trials
        )
        yield f"```\n{command}\n```"

    def _by_policy(self, table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
        """The rows of each policy that has some, in the order of the report."""
        for policy in self.policies:
            rows = table[table.policy == policy]
            if len(rows):
                yield policy, rows

    def _picture(self, name: str) -> Path:
        folder = self.out / "figures"
        folder.mkdir(exist_ok=True)
        return folder / name


def ordered(policies: Iterable[str]) -> list[str]:
    """Each policy once, in the order of the report."""
    return sorted(set(policies), key=_place)


def _place(policy: str) -> tuple[int, str]:
    """The order of the report: variants behind what they vary."""
    names = [*DESCRIPTIONS, *(name for name in POLICIES if name not in DESCRIPTIONS)]
    base = policy if policy in names else Variant.parse(policy).base
    return names.index(base), "" if policy in names else policy


def _description(policy: str) -> str:
    if policy in DESCRIPTIONS:
        return DESCRIPTIONS[policy]
    variant = Variant.parse(policy)
    if not variant.overrides:
        return f"`{policy}`"
    return f"{variant.base} with {', '.join(f'`{item}`' for item in variant.overrides)}"


def _late_gain(curve: Sequence[Mapping[str, float]]) -> float:
    """By which share the least error fell in the last third of a training."""
    errors = [point["validation_error"] for point in curve]
    return 1 - min(errors) / min(errors[: max(1, 2 * len(errors) // 3)])

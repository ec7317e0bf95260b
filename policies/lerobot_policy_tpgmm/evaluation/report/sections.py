"""The sections of a report, each a list of lines in Markdown."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_policy_tpgmm.evaluation.benchmarks import Benchmark
from lerobot_policy_tpgmm.evaluation.cells import NOMINAL
from lerobot_policy_tpgmm.evaluation.report.figures import (
    draw_curves,
    draw_errors,
    draw_success,
)
from lerobot_policy_tpgmm.evaluation.report.intervals import wilson
from lerobot_policy_tpgmm.evaluation.settings import Settings

__all__ = ["Sections"]

#: What each policy is, in the order of the report.
DESCRIPTIONS = {
    "tpgmm": "task-parameterised Gaussian mixture: the hands' poses seen from the objects, "
    "and the joints",
    "tpgmm-position-only": "the same without the orientation of the hands",
    "act": "LeRobot's Action Chunking Transformer on joints and object poses",
    "act-phase": "the same, informed of the time and learning from episodes on a common clock",
    "diffusion": "LeRobot's Diffusion Policy on joints and object poses",
    "diffusion-phase": "the same, informed of the time and learning from episodes on a common "
    "clock",
    "nearest": "replays the demonstration whose objects stood nearest: the naive floor",
}


class Sections:
    """Text and pictures of a comparison.

    Parameters
    ----------
    out : Path
        Where pictures go, in the folder ``figures``.
    settings : Settings
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
        self.benchmark: Benchmark = settings.benchmark()
        self.policies = [name for name in DESCRIPTIONS if name in set(cells.policy)]
        self.counts = sorted(set(cells.demonstrations))
        disturbed = sorted(set(cells.condition) - {NOMINAL}, key=lambda name: name.count("+"))
        self.conditions = [NOMINAL, *disturbed]
        self.trainings = {
            (r["cell"]["policy"], r["cell"]["demonstrations"], r["cell"]["seed"]): r["training"]
            for r in results
        }

    def text(self) -> list[str]:
        """All sections."""
        sections = (
            self._introduction,
            self._success,
            self._criteria,
            self._errors,
            self._baselines,
            self._cost,
            self._caveats,
            self._settings,
        )
        return [line for section in sections for line in section()]

    def _introduction(self) -> Iterator[str]:
        settings = self.settings
        shown = ", ".join(map(str, self.counts))
        yield (
            f"Every policy learned from the same first {shown} recorded episodes of "
            f"`{self.benchmark.env}` (the LeRobot data set `episodes/training`) and was rolled "
            f"out, through LeRobot's own rollout, in the same {settings.episodes} situations "
            f"that no episode shows (seeds {settings.seeds[0]} to {settings.seeds[-1]})."
        )
        yield ""
        yield from (f"- **{name}**: {DESCRIPTIONS[name]}" for name in self.policies)
        yield ""

    def _success(self) -> Iterator[str]:
        yield "## Success"
        yield ""
        yield "Successful episodes, and the 95 % interval of their share (Wilson)."
        for condition in self.conditions:
            part = self.episodes[self.episodes.condition == condition]
            if part.empty:
                continue
            yield from ("", f"Condition: {self._described(condition)}.", "")
            yield from self._grid(part, _rate)
            name = f"success_{condition.replace('+', '_')}.png"
            if len(set(part.policy)) > 1:
                draw_success(part, self._picture(name))
                yield from ("", f"![Success over demonstrations](figures/{name})")
        yield ""

    def _described(self, condition: str) -> str:
        if condition == NOMINAL:
            return "nominal, without disturbances"
        names = condition.split("+")
        options = {k: v for name in names for k, v in self.benchmark.disturbances[name].items()}
        return f"{' and '.join(names)} (`{json.dumps(options)}`)"

    def _criteria(self) -> Iterator[str]:
        """Which part of the skill fails."""
        criteria = self.benchmark.criteria
        part = self._nominal()
        if part.empty or not criteria.keys() <= set(part.columns):
            return
        most = part.demonstrations.max()
        part = part[part.demonstrations == most]
        yield "## What succeeds and what fails"
        yield ""
        yield f"Share of the episodes that meet each criterion, {most} demonstrations."
        yield ""
        yield from _head(["policy", *(self._criterion(key) for key in criteria)])
        for policy in self._in(part):
            rows = part[part.policy == policy]
            met = [rows[key].between(*bounds).mean() for key, bounds in criteria.items()]
            yield _line([policy, *(f"{100 * share:.0f} %" for share in met)])
        yield ""

    def _criterion(self, key: str) -> str:
        heading, _ = self.benchmark.figures[key]
        low, high = self.benchmark.criteria[key]
        return f"{heading} ≤ {high:g}" if math.isfinite(high) else f"{heading} ≥ {low:g}"

    def _errors(self) -> Iterator[str]:
        part = self._nominal()
        if part.empty:
            return
        figures = {k: v for k, v in self.benchmark.figures.items() if k in part}
        yield "## Errors"
        yield ""
        yield "Median / 95th percentile over the episodes, nominal condition."
        yield ""
        yield from _head(["demonstrations", "policy", *(text for text, _ in figures.values())])
        for count in self.counts:
            for policy in self.policies:
                rows = part[(part.policy == policy) & (part.demonstrations == count)]
                if len(rows):
                    spreads = [
                        _spread(rows[key], digits) for key, (_, digits) in figures.items()
                    ]
                    yield _line([str(count), policy, *spreads])
        draw_errors(part, figures, self.benchmark.criteria, self._picture("errors.png"))
        yield from ("", "Dotted: what a success allows.")
        yield from ("", "![Median and quartiles of the errors](figures/errors.png)", "")

    def _baselines(self) -> Iterator[str]:
        trained = {key: item for key, item in self.trainings.items() if item["curve"]}
        if not trained:
            return
        yield "## How the baselines were trained"
        yield ""
        yield (
            f"Every {_one(trained)['recipe']['check_every']} steps the moving average of the "
            f"weights is tried on {self.settings.validation} held-out episodes that no policy "
            "learns from: the error of the actions is the mean distance between predicted and "
            "demonstrated joint references over the steps that are executed before the next "
            "prediction. When it has not fallen by 1 % for some checks, the learning rate "
            "falls to a third (it also does towards the end of the budget); when that no "
            f"longer helps, or {self.settings.budget / 60:g} minutes of one processor are used "
            "up, training ends. The weights of the least error are the ones evaluated."
        )
        yield ""
        columns = ("steps", "minutes", "least error [mrad]", "at step", "why it ended")
        yield from _head(["policy", "demonstrations", "seed", *columns])
        for (policy, count, seed), item in trained.items():
            curve = item["curve"]
            best = min(curve, key=lambda point: point["validation_error"])
            values = (
                f"{curve[-1]['step']}",
                f"{curve[-1]['seconds'] / 60:.1f}",
                f"{1e3 * best['validation_error']:.2f}",
                f"{best['step']}",
                item["outcome"],
            )
            yield _line([policy, str(count), str(seed), *values])
        draw_curves(
            [
                {"policy": p, "demonstrations": n, "seed": s, "curve": item["curve"]}
                for (p, n, s), item in trained.items()
            ],
            self._picture("learning_curves.png"),
        )
        yield from ("", "![Learning curves](figures/learning_curves.png)", "")
        yield from ("Recipes:", "")
        recipes = {policy: item["recipe"] for (policy, _, _), item in trained.items()}
        yield from (f"- {name}: `{json.dumps(recipe)}`" for name, recipe in recipes.items())
        yield ""

    def _cost(self) -> Iterator[str]:
        rows = self.cells.sort_values("demonstrations").groupby("policy").tail(1)
        yield "## What it costs"
        yield ""
        yield (
            "With the most demonstrations. An action is everything from the raw observation to "
            "the joint references for one robot, on one thread; policies that predict chunks "
            "compute one every so many steps and take its actions from memory in between."
        )
        yield ""
        yield from _head(
            [
                "policy",
                "training [s]",
                "parameters",
                "on disk [MB]",
                "rate [Hz]",
                "step, median / 99 % [ms]",
                "steps per chunk",
                "chunk, median / 99 % [ms]",
            ]
        )
        for _, row in rows.set_index("policy").loc[self._in(rows)].reset_index().iterrows():
            yield _line(
                [
                    row.policy,
                    f"{row.training_seconds:.0f}",
                    f"{row.parameters:,}".replace(",", " "),
                    f"{row.bytes / 1e6:.1f}",
                    f"{row.fps}",
                    f"{row.step_median_ms:.2f} / {row.step_p99_ms:.2f}",
                    f"{row.chunk_size:.0f}",
                    f"{row.chunk_median_ms:.2f} / {row.chunk_p99_ms:.2f}",
                ]
            )
        yield ""

    def _caveats(self) -> Iterator[str]:
        yield from ("## What to keep in mind", "")
        yield from (f"- {text}" for text in self._remarks())
        yield ""

    def _remarks(self) -> Iterator[str]:
        """What the data say about themselves."""
        summary = self.out / "episodes" / "summary.json"
        if summary.exists():
            successes = json.loads(summary.read_text(encoding="utf-8"))["successes"]
            yield (
                f"By the environment's own criteria {sum(successes)} of the {len(successes)} "
                "recorded demonstrations succeed."
            )
        trials = self.settings.episodes
        low, high = wilson(trials // 2, trials)
        yield (
            f"With {trials} episodes a rate around one half is known to "
            f"{50 * (high - low):.0f} percentage points, either way."
        )
        seeds = len(set(self.cells.seed))
        if seeds == 1:
            yield (
                "Each policy was trained with one seed: the intervals say how much the choice "
                "of situations matters, not how much another training would differ."
            )
        else:
            yield (
                f"Episodes of {seeds} training seeds are taken together; the intervals treat "
                "them as independent."
            )
        yield from self._rivals()
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
            f"{', '.join(map(str, sorted(processors)))} processors; compare them with one "
            "another, not with a robot's computer."
        )

    def _rivals(self) -> Iterator[str]:
        """TP-GMM and the best of the others, for each number of demonstrations."""
        part = self._nominal()
        for count in self.counts:
            rows = part[part.demonstrations == count]
            rates = rows.groupby("policy").success.agg(["sum", "count", "mean"])
            others = rates[~rates.index.str.startswith("tpgmm")]
            if "tpgmm" not in rates.index or others.empty:
                continue
            best = str(others["mean"].idxmax())
            own, other = (
                wilson(int(rates["sum"][name]), int(rates["count"][name]))
                for name in ("tpgmm", best)
            )
            apart = own[0] > other[1] or other[0] > own[1]
            yield (
                f"From {count} demonstrations tpgmm succeeds in "
                f"{100 * rates['mean']['tpgmm']:.0f} % and {best}, the best of the others, in "
                f"{100 * rates['mean'][best]:.0f} %; their intervals "
                f"{'do not overlap' if apart else 'overlap'}."
            )

    def _settings(self) -> Iterator[str]:
        yield from ("## Settings", "")
        result, trials = self.results[0], self.settings.episodes
        versions = {json.dumps(item["versions"]) for item in self.results}
        machines = {json.dumps(item["machine"]) for item in self.results}
        seeds = ", ".join(map(str, sorted(set(self.cells.seed))))
        yield from _head(["setting", "value"])
        known = {**result["settings"], "options": dict(self.settings.options)}
        for key, value in known.items():
            yield _line([key.replace("_", " "), f"`{json.dumps(value)}`"])
        yield _line(["training seeds", seeds])
        yield from (_line(["versions", f"`{text}`"]) for text in sorted(versions))
        yield from (_line(["machine", f"`{text}`"]) for text in sorted(machines))
        yield from (
            "",
            "`cells.csv` has a row for each cell, `episodes_evaluated.csv` one for each "
            "episode (both also as parquet). `policies/` holds what was trained; all but "
            "`nearest` run in LeRobot's own evaluation, at the rate of the table above:",
            "",
            "```",
            "lerobot-eval --policy.path=policies/NAME --policy.device=cpu "
            f"--env.type={self.benchmark.env} --env.fps=RATE "
            f"--eval.n_episodes={trials} --eval.batch_size={trials} "
            f"--eval.use_async_envs=false --seed={self.settings.seeds[0]}",
            "```",
            "",
        )

    def _nominal(self) -> pd.DataFrame:
        return self.episodes[self.episodes.condition == NOMINAL]

    def _in(self, table: pd.DataFrame) -> list[str]:
        return [policy for policy in self.policies if policy in set(table.policy)]

    def _picture(self, name: str) -> Path:
        folder = self.out / "figures"
        folder.mkdir(exist_ok=True)
        return folder / name

    def _grid(self, part: pd.DataFrame, cell: Callable[[pd.DataFrame], str]) -> Iterator[str]:
        """Policies down, numbers of demonstrations across."""
        yield from _head(["policy", *(f"{count} demonstrations" for count in self.counts)])
        for policy in self._in(part):
            rows = part[part.policy == policy]
            groups = [rows[rows.demonstrations == count] for count in self.counts]
            yield _line([policy, *(cell(rows) if len(rows) else "-" for rows in groups)])


def _rate(rows: pd.DataFrame) -> str:
    successes, trials = int(rows.success.sum()), len(rows)
    low, high = wilson(successes, trials)
    share = 100 * successes / trials
    return f"{successes}/{trials} = {share:.0f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def _spread(values: pd.Series[Any], digits: int) -> str:
    # not interpolated: a figure may be infinite
    late = values.quantile(0.95, interpolation="higher")
    return f"{values.median():.{digits}f} / {late:.{digits}f}"


def _late_gain(curve: Sequence[Mapping[str, float]]) -> float:
    """By which share the least error fell in the last third of a training."""
    errors = [point["validation_error"] for point in curve]
    return 1 - min(errors) / min(errors[: max(1, 2 * len(errors) // 3)])


def _one(items: Mapping[Any, Any]) -> Any:
    return next(iter(items.values()))


def _head(cells: Sequence[str]) -> tuple[str, str]:
    return _line(cells), _line(["---"] * len(cells))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"

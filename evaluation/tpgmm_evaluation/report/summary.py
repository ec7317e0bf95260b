"""The report of a comparison in several environments: what loses, and why, first."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from lerobot_env_bimanual.disturbances import NOMINAL, parse_condition
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.report import pages
from tpgmm_evaluation.report.failures import (
    criterion,
    evaluation_command,
    failed_episodes,
    missed,
)
from tpgmm_evaluation.report.figures import draw_conditions, draw_success
from tpgmm_evaluation.report.significance import LEVEL, PAIR, PLACE, REFERENCE, paired
from tpgmm_evaluation.report.tables import (
    cell_table,
    demonstration_table,
    episode_table,
    wilson,
    write_table,
)
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import Variant
from tpgmm_torch.atomic import replacing

__all__ = ["Task", "best_others", "write_summary"]

#: Share of the demonstrations that should succeed by the rules of their environment.
ASKED = 0.98
#: Failed episodes that the page shows; the table beside it has all.
SHOWN = 30
#: Policies with a heat map of their own.
MAPS = 4


@dataclass(frozen=True)
class Task:
    """Content of the folder of an environment.

    Parameters
    ----------
    folder : Path
        The folder.
    settings : Settings
        Of all its cells.
    results : list of dict
        Its finished cells, as :class:`Results` reads them.
    """

    folder: Path
    settings: Settings
    results: Sequence[Mapping[str, Any]]


def write_summary(
    out: Path, tasks: Sequence[Task], failures: Mapping[Cell, str], command: str
) -> Path:
    """Write the report of a folder, and the tables it is made from.

    Parameters
    ----------
    out : Path
        The folder: ``report.md``, ``figures/``; ``results.parquet``, a row for each episode;
        ``cells``, ``comparisons`` and ``failures``, each as parquet and CSV.
    tasks : sequence of Task
        The environments, in the order of the report.
    failures : mapping
        Cells that could not be finished, with the reason.
    command : str
        What was called; the report lists it after those of earlier calls.

    Returns
    -------
    Path
        The report.
    """
    out.mkdir(parents=True, exist_ok=True)
    paragraphs = ["# What demonstrations buy"]
    if any(task.results for task in tasks):
        paragraphs += _Summary(out, [task for task in tasks if task.results])
    paragraphs += pages.failed_cells("Cells that could not be run", failures)
    commands = _commands(out / "commands.txt", command)
    if commands:
        paragraphs += ["## Commands", pages.block(commands)]
    return pages.write_page(out / "report.md", paragraphs)


def _commands(path: Path, command: str) -> list[str]:
    """All that were called, this one last."""
    commands = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    if command and command not in commands:
        commands.append(command)
        with replacing(path) as file:
            file.write_text("\n".join(commands) + "\n", encoding="utf-8")
    return commands


def best_others(comparisons: pd.DataFrame) -> pd.DataFrame:
    """Of the comparisons in one place, that with the strongest policy which is no TP-GMM.

    Parameters
    ----------
    comparisons : DataFrame
        As :func:`~tpgmm_evaluation.report.significance.paired` makes it.

    Returns
    -------
    DataFrame
        A row for each environment, number of demonstrations and condition. The strongest is
        the one with the highest share of successes; among equals, that which TP-GMM is least
        surely better than.
    """
    rivals = [policy for policy in set(comparisons.policy) if not _ours(policy)]
    others = comparisons[comparisons.policy.isin(rivals)]
    others = others.assign(share=others.other_successes / others.pairs)
    ranked = others.sort_values(["share", "only_reference"], ascending=[False, True])
    places = ranked.drop_duplicates(["env", "demonstrations", "condition"])
    return places.sort_index()


def _ours(policy: str) -> bool:
    """Whether it is TP-GMM, if with a part removed or other settings."""
    return Variant.parse(policy).base.startswith(REFERENCE)


class _Summary:
    """Text and pictures, in Markdown; tables are written on the way.

    Parameters
    ----------
    out : Path
        The folder.
    tasks : sequence of Task
        Those with results.
    """

    def __init__(self, out: Path, tasks: Sequence[Task]) -> None:
        self.out = out
        self.tasks = {task.settings.env: task for task in tasks}
        self.benchmarks = {env: task.settings.benchmark() for env, task in self.tasks.items()}
        results = [result for task in tasks for result in task.results]
        self.cells, self.episodes = cell_table(results), episode_table(results)
        self.nominal = self.episodes[self.episodes.condition == NOMINAL]
        self.policies = pages.ordered(self.cells.policy)
        self.counts = sorted(set(self.cells.demonstrations))
        self.comparisons = paired(self.episodes)
        ours = self.episodes[self.episodes.policy == REFERENCE]
        self.failed = failed_episodes(ours, self.benchmarks).sort_values(
            ["condition", "env", "demonstrations", "training_seed", "evaluation_seed"],
            # nominal episodes first, and with the most demonstrations, where failures count
            key=lambda column: column != NOMINAL if column.name == "condition" else column,
            ascending=[True, True, False, True, True],
            kind="stable",
        )
        with replacing(out / "results.parquet") as file:
            self.episodes.to_parquet(file, index=False)
        write_table(self.cells, out / "cells")
        write_table(self.comparisons, out / "comparisons")
        write_table(self.failed, out / "failures")

    def __iter__(self) -> Iterator[str]:
        yield self._introduction()
        yield pages.bullets(f"**{name}**: {pages.described(name)}" for name in self.policies)
        yield from self._losses()
        yield from self._failed()
        yield from self._statements()
        yield from self._success()
        yield from self._conditions()
        yield from self._errors()
        yield from pages.cost_table(self.cells[self.cells.condition == NOMINAL])
        yield from self._demonstrations()
        yield "## What to keep in mind"
        yield pages.bullets(self._remarks())
        yield self._files()

    def _introduction(self) -> str:
        seeds = self.cells.seed.nunique()
        return (
            f"Tasks: {', '.join(self.tasks)}. Every policy learned from the same "
            f"{pages.listed(self.counts)} demonstrations, in {seeds} training "
            f"seed{'s' * (seeds > 1)}, and was rolled out in the same situations, which no "
            "demonstration shows."
        )

    def _losses(self) -> Iterator[str]:
        """Every comparison in which another policy solves more."""
        yield f"## Where {REFERENCE} loses, and why"
        if self.comparisons.empty:
            yield f"Nothing was evaluated beside {REFERENCE}: there is nothing to lose to."
            return
        nominal = int((self.comparisons.condition == NOMINAL).sum())
        total = len(self.comparisons)
        yield (
            "Two policies are compared in the episodes that both were tried in (the same "
            "training seed and evaluation seed) by McNemar's test, exact and two-sided, on "
            "those that one of them alone solves. Holm's correction counts all comparisons "
            f"without disturbances ({nominal}), and all others ({total - nominal}); "
            f"significant is p < {LEVEL}. Episodes of one training seed share its "
            "demonstrations, which the test does not know: in how many seeds the sign is the "
            "same stands beside it."
        )
        lost = self.comparisons[self.comparisons.only_other > self.comparisons.only_reference]
        if lost.empty:
            yield f"In none of {total} comparisons does another policy solve more episodes."
            return
        worse = int((lost.p_holm < LEVEL).sum())
        yield (
            f"In {len(lost)} of {total} comparisons another policy solves more episodes; in "
            f"{worse} of them significantly so."
        )
        lost = lost.sort_values(["p_holm", "p"], kind="stable")
        head = ["task", "demonstrations", "condition", "other policy", REFERENCE, "other"]
        head += [f"solved by other / {REFERENCE} alone", "seeds", "p", "p (Holm)", "verdict"]
        rows = [
            [
                *(row.env, row.demonstrations, row.condition, row.policy),
                *(pages.share(n, row.pairs) for n in (row.successes, row.other_successes)),
                f"{row.only_other} / {row.only_reference}",
                f"{row.seeds_worse} of {row.seeds}",
                *(f"{row.p:.2g}", f"{row.p_holm:.2g}", row.verdict),
            ]
            for row in lost.itertuples()
        ]
        yield pages.table(head, rows)
        yield f"What {REFERENCE} missed in the episodes that the other policy alone solves:"
        yield pages.bullets(map(self._reason, lost.itertuples()))

    def _reason(self, row: Any) -> str:
        """Which criteria decided a lost comparison."""
        benchmark, episodes = self.benchmarks[row.env], self.episodes
        place = (episodes[PLACE] == [getattr(row, key) for key in PLACE]).all(axis=1)
        solved = episodes.success.astype(bool)
        ours = episodes[place & (episodes.policy == REFERENCE) & ~solved]
        theirs = episodes[place & (episodes.policy == row.policy) & solved]
        both = ours.merge(theirs[PAIR], on=PAIR)
        counts = Counter(
            key for episode in both.to_dict("records") for key in missed(episode, benchmark)
        )
        texts = [
            f"{criterion(benchmark, key)} in {count}" for key, count in counts.most_common()
        ]
        seeds = pages.listed(set(both.evaluation_seed))
        where = "" if row.condition == NOMINAL else f", {row.condition}"
        return (
            f"{row.env}, {row.demonstrations} demonstrations{where}, {row.policy}: "
            f"{'; '.join(texts) or 'no criterion of its own'}, of {len(both)} (evaluation "
            f"seeds {seeds})"
        )

    def _failed(self) -> Iterator[str]:
        """Episodes that the reference does not solve, to be seen again."""
        yield f"### Episodes that {REFERENCE} fails in"
        trials = int((self.episodes.policy == REFERENCE).sum())
        if not len(self.failed):
            yield f"None of {trials}."
            return
        shown = min(SHOWN, len(self.failed))
        yield (
            f"{len(self.failed)} of {trials}; {shown} of them here, all in `failures.csv`. In "
            "brackets what came of it."
        )
        head = ("task", "demonstrations", "training seed", "condition", "evaluation seed")
        keys = ["env", "demonstrations", "training_seed", "condition", "evaluation_seed"]
        rows = self.failed.head(SHOWN)[[*keys, "missed"]].itertuples(index=False)
        yield pages.table([*head, "missed"], rows)
        yield "The first of each task and condition again, in the folder of this report:"
        commands = []
        for row in self.failed.drop_duplicates(["env", "condition"]).itertuples():
            cell = Cell(row.env, row.policy, row.demonstrations, row.training_seed)
            settings = self.tasks[row.env].settings
            directory = f"{row.env}/policies/{cell.training}"
            rate = self.cells.fps[self.cells.env == row.env][self.cells.policy == row.policy]
            commands.append(
                evaluation_command(
                    settings, row.condition, directory, rate.iloc[0], row.evaluation_seed, 1
                )
            )
        yield pages.block(commands)

    def _statements(self) -> Iterator[str]:
        """Better, level or worse than the strongest of the others."""
        best = best_others(self.comparisons)
        best = best[best.condition == NOMINAL]
        if best.empty:
            return
        yield f"## {REFERENCE} against the best of the others"
        yield (
            "Without disturbances. Which of the others is best is seen afterwards, which the "
            "correction allows for: it counts the comparisons with all of them."
        )
        texts = {(row.env, row.demonstrations): _statement(row) for row in best.itertuples()}
        rows = [[env, *(texts.get((env, n), "-") for n in self.counts)] for env in self.tasks]
        yield pages.table(["task", *self._headings()], rows)
        yield pages.bullets(
            f"From {count} demonstrations {REFERENCE} is significantly better than the best of "
            f"the others on {(verdicts == 'better').sum()} of {len(verdicts)} tasks, "
            f"significantly worse on {(verdicts == 'worse').sum()}."
            for count, verdicts in best.groupby("demonstrations").verdict
        )

    def _headings(self) -> list[str]:
        return [f"{count} demonstrations" for count in self.counts]

    def _success(self) -> Iterator[str]:
        if self.nominal.empty:
            return
        yield "## Success"
        yield "Successful episodes, and the 95 % interval of their share (Wilson)."
        rows = [
            [env, *row]
            for env in self.tasks
            for row in pages.success_rows(self.nominal[self.nominal.env == env], self.counts)
        ]
        yield pages.table(["task", "policy", *self._headings()], rows)
        draw_success(self.nominal, pages.picture(self.out, "success"))
        yield ("![Success over demonstrations, a panel for each task](figures/success.webp)")
        yield "Small dots: the training seeds, each with demonstrations of its own."
        yield from self._means()

    def _means(self) -> Iterator[str]:
        """Over the tasks that each policy was tried in."""
        if len(self.tasks) == 1:
            return
        yield "Mean of the tasks, its lowest, and on how many it has 95 % or more:"
        rates = self.nominal.groupby(["policy", "demonstrations", "env"]).success.mean()
        texts = {
            place: f"{100 * part.mean():.0f} % ({100 * part.min():.0f} %; "
            f"{(part >= 0.95).sum()} of {len(part)})"
            for place, part in rates.groupby(["policy", "demonstrations"])
        }
        rows = [
            [policy, *(texts.get((policy, count), "-") for count in self.counts)]
            for policy in pages.ordered(self.nominal.policy)
        ]
        yield pages.table(["policy", *self._headings()], rows)

    def _conditions(self) -> Iterator[str]:
        """Where something goes wrong, with the most demonstrations that it was tried with."""
        disturbed = self.episodes[self.episodes.condition != NOMINAL]
        if disturbed.empty:
            return
        most = disturbed.demonstrations.max()
        part = self.episodes[self.episodes.demonstrations == most]
        disturbed = disturbed[disturbed.demonstrations == most]
        policies = pages.ordered(disturbed.policy)
        known = [c for b in self.benchmarks.values() for c in b.all_conditions]
        found = set(part.condition)
        conditions = [name for name in dict.fromkeys(known) if name in found]
        conditions += sorted(found - set(conditions))
        yield "## Conditions"
        yield (
            f"Successful episodes of each task in each condition, {most} demonstrations. The "
            "last column: all disturbed episodes together, with the 95 % interval of the share "
            "(Wilson)."
        )
        others = [name for name in conditions if name != NOMINAL]
        yield pages.bullets(f"`{name}`: {self._described(name)}" for name in others)
        maps = {}
        for policy in policies:
            chosen = part[part.policy == policy]
            grid = chosen.groupby(["env", "condition"]).success.agg(["sum", "count"])
            envs = [env for env in self.tasks if env in set(chosen.env)]
            rows = []
            for env in envs:
                cells = [_count(grid, env, condition) for condition in conditions]
                theirs = disturbed[(disturbed.policy == policy) & (disturbed.env == env)]
                rows.append([env, *cells, pages.rate(theirs)])
            yield f"{policy}:"
            yield pages.table(["task", *conditions, "disturbed"], rows)
            shares = chosen.pivot_table(values="success", index="env", columns="condition")
            maps[policy] = shares.astype(float).reindex(index=envs, columns=conditions)
        draw_conditions(dict(list(maps.items())[:MAPS]), pages.picture(self.out, "conditions"))
        yield "![Success in percent, by task and condition](figures/conditions.webp)"

    def _described(self, condition: str) -> str:
        """Text of a condition: the options of each disturbance, or its first line."""
        options = {k: v for b in self.benchmarks.values() for k, v in b.disturbances.items()}
        texts = [
            f"`{json.dumps(options[name])}`." if name in options
            else str(type(parse_condition(name)[0]).__doc__).partition("\n")[0]
            for name in condition.split("+")
        ]  # fmt: skip
        return " ".join(texts)

    def _errors(self) -> Iterator[str]:
        """Figures of all policies, task by task."""
        if self.nominal.empty:
            return
        yield "## Errors"
        yield "Median / 95th percentile over the episodes without disturbances."
        for env, benchmark in self.benchmarks.items():
            # figures that only other tasks have are all NaN here
            part = self.nominal[self.nominal.env == env].dropna(axis=1, how="all")
            groups = (
                ((count, policy), rows)
                for count, chosen in part.groupby("demonstrations")
                for policy, rows in pages.by_policy(chosen)
            )
            if len(part):
                yield f"{env}:"
                figures = pages.known(benchmark.figures, part)
                yield pages.figure_table(["demonstrations", "policy"], groups, figures)

    def _demonstrations(self) -> Iterator[str]:
        yield "## Demonstrations"
        yield (
            "How many of the expert's attempts succeed by the rules of their environment, of "
            f"which {100 * ASKED:.0f} % are asked for; what does not is not learned from."
        )
        rows: list[list[object]] = []
        for env, task in self.tasks.items():
            table = demonstration_table(task.folder)
            tried, succeed = int(table.tried.sum()), int(table.succeed.sum())
            if not tried:
                rows.append([env, "-", "not at hand", "-"])
                continue
            low, high = wilson(succeed, tried)
            share = pages.share(succeed, tried)
            met = "yes" if succeed >= ASKED * tried else "**no**"
            text = f"{succeed}/{tried} = {share} ({100 * low:.0f} to {100 * high:.0f} %)"
            rows.append([env, pages.listed(table.seed), text, met])
        yield pages.table(["task", "seeds", "succeed", "as asked"], rows)

    def _remarks(self) -> Iterator[str]:
        yield pages.uncertainty(min(task.settings.episodes for task in self.tasks.values()))
        fixed = [
            e for e, task in self.tasks.items() if task.settings.demonstration_seed is not None
        ]
        listed = ", ".join(fixed)
        if self.cells.seed.nunique() == 1:
            yield (
                "One training seed: the intervals say how much the choice of situations "
                "matters, not how much other demonstrations or another training would change."
            )
        elif fixed:
            yield (
                f"All training seeds learned from the same demonstrations in {listed}: how "
                "much others would change is not seen there."
            )
        else:
            yield (
                "Each training seed draws demonstrations of its own. Intervals pool the seeds "
                "and treat episodes as independent, which those of one training are not quite: "
                "look at the dots of the figure too."
            )

    def _files(self) -> str:
        return (
            "`results.parquet` has a row for each episode, `cells.csv` for each cell, "
            "`comparisons.csv` for each test, `failures.csv` for each failed episode of "
            f"{REFERENCE} (the last three also as parquet). `tpgmm compare --report-only --out "
            "DIR` writes this page again from the cells."
        )


def _statement(row: Any) -> str:
    ours, theirs = (pages.share(n, row.pairs) for n in (row.successes, row.other_successes))
    tested = f", p = {row.p_holm:.2g}" if row.only_reference + row.only_other else ""
    return f"{row.verdict}{tested} ({ours}; {row.policy} {theirs})"


def _count(grid: pd.DataFrame, env: str, condition: str) -> str:
    if (env, condition) not in grid.index:
        return "-"
    row = grid.loc[(env, condition)]
    return f"{int(row['sum'])}/{int(row['count'])}"

"""The report of a comparison in several environments: what loses, and why, first."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from lerobot_env_bimanual.disturbances import NOMINAL, parse_condition
from tpgmm_evaluation.cells import Cell
from tpgmm_evaluation.report import pages
from tpgmm_evaluation.report.failures import (
    criterion,
    evaluation_command,
    list_failures,
    missed_criteria,
)
from tpgmm_evaluation.report.figures import draw_conditions, draw_success
from tpgmm_evaluation.report.significance import LEVEL, PAIR, PLACE, REFERENCE, compare_pairs
from tpgmm_evaluation.report.tables import (
    cell_table,
    count_demonstrations,
    episode_table,
    wilson,
    write_table,
)
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import Variant
from tpgmm_torch.atomic import replacing

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
        With its episodes, cells and policies.
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
    tried = [task for task in tasks if task.results]
    summary = _Summary(tried) if tried else None
    if summary is not None:
        summary.write_tables(out)
        summary.draw(out / "figures")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        autoescape=False,
    )
    text = environment.get_template("report.md.jinja").render(
        s=summary,
        failures=failures,
        commands=_keep_command(out / "commands.txt", command),
        describe_variant=pages.describe_variant,
        share=pages.share,
        rate_of=pages.rate_of,
        reference=REFERENCE,
        nominal=NOMINAL,
        level=LEVEL,
        shown=SHOWN,
        share_asked=ASKED,
    )
    return pages.write_page(out / "report.md", text)


def _keep_command(path: Path, command: str) -> list[str]:
    """Add a command to a file, unless it is there; return all commands."""
    commands = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    if command and command not in commands:
        commands.append(command)
        pages.write_page(path, "\n".join(commands))
    return commands


def best_others(comparisons: pd.DataFrame) -> pd.DataFrame:
    """Select in each place the comparison with the strongest policy that is no TP-GMM.

    Parameters
    ----------
    comparisons : DataFrame
        As :func:`~tpgmm_evaluation.report.significance.compare_pairs` makes it.

    Returns
    -------
    DataFrame
        A row for each environment, number of demonstrations and condition. The strongest is
        the one with the highest share of successes; among equals, that which TP-GMM is least
        surely better than.
    """
    ours = comparisons.policy.map(lambda policy: Variant.parse(policy).base)
    others = comparisons[~ours.astype(str).str.startswith(REFERENCE)]
    others = others.assign(share=others.other_successes / others.pairs)
    ranked = others.sort_values(["share", "only_reference"], ascending=[False, True])
    return ranked.drop_duplicates(PLACE).sort_index()


class _Summary:
    """Numbers and tables of the report, in Markdown.

    Parameters
    ----------
    tasks : sequence of Task
        Those with results.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        self.tasks = {task.settings.env: task for task in tasks}
        self.benchmarks = {env: task.settings.benchmark() for env, task in self.tasks.items()}
        results = [result for task in tasks for result in task.results]
        self.cells, self.episodes = cell_table(results), episode_table(results)
        self.comparisons = compare_pairs(self.episodes)
        self.policies = pages.order_policies(self.cells.policy)
        self.counts = sorted(set(self.cells.demonstrations))
        self.n_seeds = self.cells.seed.nunique()
        self.n_nominal = int((self.comparisons.condition == NOMINAL).sum())
        self.n_trials = int((self.episodes.policy == REFERENCE).sum())
        self.failed = self._list_failures()
        lost = self.comparisons[self.comparisons.only_other > self.comparisons.only_reference]
        self.lost = lost.sort_values(["p_holm", "p"], kind="stable")
        best = best_others(self.comparisons)
        self.best = best[best.condition == NOMINAL]
        # what is grouped by environment or policy comes in the order of the report
        ordered = self.episodes.assign(
            env=pd.Categorical(self.episodes.env, [*self.tasks]),
            policy=pd.Categorical(self.episodes.policy, self.policies),
        )
        self.nominal = ordered[ordered.condition == NOMINAL]
        self._select_disturbed(ordered)
        settings = [task.settings for task in tasks]
        self.fixed = [s.env for s in settings if s.demonstration_seed is not None]
        self.episodes_per_cell = min(s.episodes for s in settings)
        low, high = wilson(self.episodes_per_cell // 2, self.episodes_per_cell)
        self.uncertainty = f"{50 * (high - low):.0f}"

    def _list_failures(self) -> pd.DataFrame:
        """List failed episodes: nominal ones first, and those with the most demonstrations."""
        ours = self.episodes[self.episodes.policy == REFERENCE]
        return list_failures(ours, self.benchmarks).sort_values(
            ["condition", "env", "demonstrations", "training_seed", "evaluation_seed"],
            key=lambda column: column != NOMINAL if column.name == "condition" else column,
            ascending=[True, True, False, True, True],
            kind="stable",
        )

    def _select_disturbed(self, episodes: pd.DataFrame) -> None:
        """Select episodes beside disturbed ones, with the most demonstrations tried there."""
        self.most = episodes[episodes.condition != NOMINAL].demonstrations.max()
        beside = episodes[episodes.demonstrations == self.most]
        self.disturbed = beside[beside.condition != NOMINAL]
        self.disturbed_policies = pages.order_policies(self.disturbed.policy)
        known = [c for b in self.benchmarks.values() for c in b.all_conditions]
        found = set(beside.condition)
        ordered = [name for name in dict.fromkeys(known) if name in found]
        self.conditions = [*ordered, *sorted(found - set(ordered))]
        groups = beside.groupby(["policy", "env", "condition"], observed=True)
        self.solved = groups.success.agg(["sum", "count"])

    def write_tables(self, out: Path) -> None:
        """Write the tables behind the report."""
        with replacing(out / "results.parquet") as file:
            self.episodes.to_parquet(file, index=False)
        write_table(self.cells, out / "cells")
        write_table(self.comparisons, out / "comparisons")
        write_table(self.failed, out / "failures")

    def draw(self, folder: Path) -> None:
        """Draw the figures of the report."""
        folder.mkdir(exist_ok=True)
        if not self.nominal.empty:
            draw_success(self.nominal, folder / "success")
        if self.conditions:
            shares = (self.solved["sum"] / self.solved["count"]).unstack()[self.conditions]
            rates = {policy: shares.loc[policy] for policy in self.disturbed_policies[:MAPS]}
            draw_conditions(rates, folder / "conditions")

    def reasons(self) -> Iterator[str]:
        """Name the criteria that decided each lost comparison."""
        for row in self.lost.itertuples():
            benchmark = self.benchmarks[row.env]
            place = {key: [getattr(row, key)] for key in PLACE}
            here = self.episodes.merge(pd.DataFrame(place), on=PLACE)
            ours = here[(here.policy == REFERENCE) & ~here.success]
            theirs = here[(here.policy == row.policy) & here.success]
            both = ours.merge(theirs[PAIR], on=PAIR)
            episodes = both.to_dict("records")
            counts = Counter(key for one in episodes for key in missed_criteria(one, benchmark))
            texts = [f"{criterion(benchmark, key)} in {n}" for key, n in counts.most_common()]
            seeds = ", ".join(map(str, sorted(set(both.evaluation_seed))))
            where = "" if row.condition == NOMINAL else f", {row.condition}"
            yield (
                f"{row.env}, {row.demonstrations} demonstrations{where}, {row.policy}: "
                f"{'; '.join(texts) or 'no criterion of its own'}, of {len(both)} (evaluation "
                f"seeds {seeds})"
            )

    def repeat_commands(self) -> Iterator[str]:
        """Return commands that repeat the first failure of each task and condition."""
        for row in self.failed.drop_duplicates(["env", "condition"]).itertuples():
            cell = Cell(row.env, row.policy, row.demonstrations, row.training_seed)
            directory = f"{row.env}/policies/{cell.training}"
            cells = self.cells[(self.cells.env == row.env) & (self.cells.policy == row.policy)]
            settings, rate = self.tasks[row.env].settings, cells.fps.iloc[0]
            yield evaluation_command(
                settings, row.condition, directory, rate, row.evaluation_seed, 1
            )

    def _table_by_count(self, head: Sequence[str], texts: pd.Series[str]) -> str:
        """Tabulate texts with a column for each number of demonstrations."""
        rows = texts.unstack("demonstrations").reindex(columns=self.counts).fillna("-")
        columns = [f"{n} demonstrations" for n in self.counts]
        return pages.table([*head, *columns], rows.reset_index().to_numpy())

    def best_table(self) -> str:
        """Tabulate verdicts beside the strongest of the others."""
        texts = pd.Series(
            "-",
            pd.MultiIndex.from_product([self.tasks, self.counts], names=["", "demonstrations"]),
        )
        for row in self.best.itertuples():
            ours, theirs = (
                pages.share(n, row.pairs) for n in (row.successes, row.other_successes)
            )
            tested = f", p = {row.p_holm:.2g}" if row.only_reference + row.only_other else ""
            text = f"{row.verdict}{tested} ({ours}; {row.policy} {theirs})"
            texts[row.env, row.demonstrations] = text
        return self._table_by_count(["task"], texts)

    def success_table(self) -> str:
        """Tabulate successes of each task and policy."""
        groups = self.nominal.groupby(["env", "policy", "demonstrations"], observed=True)
        return self._table_by_count(["task", "policy"], groups.success.agg(pages.rate))

    def mean_table(self) -> str:
        """Tabulate means over the tasks that each policy was tried in."""
        rates = self.nominal.groupby(["policy", "demonstrations", "env"], observed=True)
        texts = rates.success.mean().groupby(["policy", "demonstrations"], observed=True)
        return self._table_by_count(
            ["policy"],
            texts.agg(
                lambda part: (
                    f"{100 * part.mean():.0f} % ({100 * part.min():.0f} %; "
                    f"{(part >= 0.95).sum()} of {len(part)})"
                )
            ),
        )

    def condition_table(self, policy: str) -> str:
        """Tabulate the successes of a policy in each task and condition."""
        solved = self.solved.loc[policy]
        texts = solved["sum"].astype(str) + "/" + solved["count"].astype(str)
        grid = texts.unstack().reindex(columns=self.conditions).fillna("-")
        theirs = self.disturbed[self.disturbed.policy == policy]
        every = theirs.groupby("env", observed=True).success.agg(pages.rate)
        grid = grid.assign(disturbed=every).fillna("-").reset_index()
        return pages.table(["task", *self.conditions, "disturbed"], grid.to_numpy())

    def describe_condition(self, condition: str) -> str:
        """Return the options of each disturbance, or the first line of its documentation."""
        options = {k: v for b in self.benchmarks.values() for k, v in b.disturbances.items()}
        texts = [
            f"`{json.dumps(options[name])}`." if name in options
            else str(type(parse_condition(name)[0]).__doc__).partition("\n")[0]
            for name in condition.split("+")
        ]  # fmt: skip
        return " ".join(texts)

    def error_tables(self) -> Iterator[tuple[str, str]]:
        """Tabulate figures of all policies, task by task."""
        for env, part in self.nominal.groupby("env", observed=True):
            # figures that only other tasks have are all NaN here
            shown = part.dropna(axis=1, how="all")
            figures = {k: f for k, f in self.benchmarks[env].figures.items() if k in shown}
            head = ["demonstrations", "policy", *(f.heading for f in figures.values())]
            rows = [
                [*place, *(pages.spread(rows[key], f.digits) for key, f in figures.items())]
                for place, rows in shown.groupby(["demonstrations", "policy"], observed=True)
            ]
            yield env, pages.table(head, rows)

    def cost_table(self) -> str:
        """Tabulate costs of training and acting."""
        return pages.cost_table(self.cells[self.cells.condition == NOMINAL])

    def demonstrations(self) -> Iterator[tuple[str, list[int], int, int]]:
        """Yield tasks, seeds, attempts of the experts, and how many of them succeed."""
        for env, task in self.tasks.items():
            table = count_demonstrations(task.folder)
            yield env, [*table.seed], int(table.tried.sum()), int(table.succeed.sum())

"""Change a room of learn or run one expression at a time; count what its own tests notice.

``make mutants ROOM=tpgmm_torch/operators``, or ``python tests/mutants.py --help``. mutmut makes
the mutants and runs, for each, the tests of ``tests/ROOM`` that reach the changed function;
what survives is tried with all of them. Everything happens on a copy, ``out/mutants/ROOM``.
"""

import argparse
import ast
import difflib
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Where the packages are whose rooms are changed; the other folders are linked beside them.
HOMES = {"tpgmm_torch": "tpgmm_torch", "tpgmm_control": "control/tpgmm_control"}
OTHERS = ("datasets", "tools", "vision", "policies", "environments", "evaluation")

#: A mutant is equivalent by rule if its line is the original one once these are blanked.
#: mutmut leaves alone annotations, docstrings, defaults other than numbers and names,
#: constants of modules and decorated functions (properties, caches, abstract methods).
EQUIVALENT = {
    "text of an error or warning": r"^raise \w+.*|warnings\.warn\(.*",
    "other device": r"(?<=\()[\w.=]*\bdevice, |(, )?[\w.=]*\bdevice(=None)?(?=[,)])",
    "zip that checks lengths which agree": r", strict=\w+",
    "type given to the type checker": r"(?<=\bcast\()[^,]+",
}

SETTINGS = """
[tool.mutmut]
source_paths = ["{package}"]
only_mutate = ["{room}/*.py"]
also_copy = {others}
pytest_add_cli_args_test_selection = ["tests/{room}"]
# the server forks tests from a process that has imported everything and run nothing
process_isolation = "forkserver"
timeout_constant = 20.0
timeout_multiplier = 3.0
"""


@dataclass(frozen=True)
class Mutant:
    """One changed line: its name at mutmut, the line before and after."""

    name: str
    before: str
    after: str

    def excluded(self) -> str | None:
        """The rule that excludes it, if one does."""
        for why, pattern in EQUIVALENT.items():
            if re.sub(pattern, "", self.before) == re.sub(pattern, "", self.after):
                return why
        before, after = (re.findall(r"\w+|\S", line) for line in (self.before, self.after))
        changes = difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
        inserted = [after[c:d] for kind, _, _, c, d in changes if kind != "equal"]
        crashes = inserted == [["None"]] and "=None" not in self.after
        return "None in place of a value, which crashes where it is run" if crashes else None


def mutants(room: str) -> Iterator[Mutant]:
    """All mutants of the modules of a room; the folder with the settings is the current one."""
    from mutmut.mutation.file_mutation import mutate_file_contents
    from mutmut.utils.format_utils import get_mutant_name

    for path in sorted(Path(room).glob("*.py")):
        mutated = mutate_file_contents(str(path), path.read_text(encoding="utf-8"))
        bodies = {
            function.name: lines(function)
            for function in ast.walk(ast.parse(mutated.code))
            if isinstance(function, ast.FunctionDef)
        }
        for name in mutated.mutant_names:
            original = bodies[re.sub(r"__mutmut_\d+$", "__mutmut_orig", name)]
            changes = difflib.ndiff(original, bodies[name])
            by_sign = {sign: [] for sign in "-+ ?"}
            for change in changes:
                by_sign[change[0]].append(change[2:].strip())
            yield Mutant(
                get_mutant_name(path, name), " ".join(by_sign["-"]), " ".join(by_sign["+"])
            )


def lines(function: ast.FunctionDef) -> list[str]:
    """One line for each statement of a function; its name does not count."""
    function.name = "_"
    return ast.unparse(function).splitlines()


def prepare(room: str) -> None:
    """Make the folder of a room, with links to the code and settings for mutmut; enter it."""
    folder = ROOT / "out" / "mutants" / room
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "mutants").mkdir(parents=True)
    for name, home in (HOMES | {name: name for name in (*OTHERS, "tests")}).items():
        (folder / name).symlink_to(ROOT / home)
    package = room.partition("/")[0]
    others = [*OTHERS, *(name for name in HOMES if name != package)]
    settings = SETTINGS.format(room=room, package=package, others=json.dumps(others))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (folder / "pyproject.toml").write_text(project + settings, "utf-8")
    os.chdir(folder)


def environment() -> dict[str, str]:
    """Variables with which also the processes that a test starts import the mutants."""
    return os.environ | {"PYTHONPATH": str(Path("mutants").resolve())}


def run(names: list[str]) -> dict[str, str]:
    """What became of these mutants, by name."""
    from mutmut.mutation.data import SourceFileMutationData
    from mutmut.stats import status_by_exit_code
    from mutmut.utils.file_utils import walk_mutatable_files

    command = [Path(sys.executable).with_name("mutmut"), "run", "--max-children", "1", *names]
    with Path("mutmut.log").open("w") as log:
        done = subprocess.run(command, env=environment(), stdout=log, stderr=log, check=False)
    if done.returncode:
        sys.exit(f"mutmut failed; see {Path('mutmut.log').resolve()}")
    codes: dict[str, int | None] = {}
    for path in walk_mutatable_files():
        data = SourceFileMutationData(path=path)
        data.load()
        codes |= data.exit_code_by_key
    return {name: status_by_exit_code[codes[name]] for name in names}


def noticed(name: str, room: str) -> bool:
    """Whether any test of the room fails with this mutant.

    mutmut knows which test reached a function first; one that is reached by a shared fixture
    is known to one test only.
    """
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--rootdir=."]
    done = subprocess.run(
        [*command, f"tests/{room}"],
        cwd="mutants",
        env=environment() | {"MUTANT_UNDER_TEST": name},
        capture_output=True,
        check=False,
    )
    return done.returncode != 0


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    rooms = sorted(
        f"{package}/{path.parent.name}"
        for package, home in HOMES.items()
        for path in ROOT.glob(f"{home}/*/__init__.py")
    )
    parser.add_argument("room", choices=rooms)
    parser.add_argument("--sample", type=int, default=60, help="how many; 0: all of them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", default="", metavar="REGEX", help="names in which it is found"
    )
    given = parser.parse_args()

    prepare(given.room)
    everything = [
        mutant for mutant in mutants(given.room) if re.search(given.only, mutant.name)
    ]
    asked = [mutant for mutant in everything if mutant.excluded() is None]
    excluded = Counter(mutant.excluded() for mutant in everything if mutant.excluded())
    size = min(given.sample or len(asked), len(asked))
    sample = random.Random(given.seed).sample(asked, size)
    print(f"{given.room}: {len(everything)} mutants, {size} of {len(asked)} tried")
    for why, count in excluded.items():
        print(f"  excluded: {count} ({why})")

    became = run([mutant.name for mutant in sample])
    for mutant in sample:
        if became[mutant.name] in ("survived", "no tests"):
            if noticed(mutant.name, given.room):
                became[mutant.name] = "killed"
            else:
                print(f"\n{mutant.name}: {became[mutant.name]}")
                print(f"  - {mutant.before}\n  + {mutant.after}", flush=True)
    counts = Counter(became.values())
    killed = counts["killed"] + counts["timeout"] + counts["segfault"]
    print(f"\n{dict(counts)}: {killed} of {size} noticed, {killed / size:.0%}")


if __name__ == "__main__":
    main()

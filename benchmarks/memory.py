"""Memory of EM above that of the points."""

from collections.abc import Iterator

from benchmarks import mixtures
from benchmarks.child import ask, peak_memory, reset_peak
from benchmarks.points import Problem, motions
from benchmarks.rows import Omitted, Row
from benchmarks.settings import Settings

__all__ = ["measure"]

LIBRARIES = {"ours": mixtures.ours, "scikit-learn": mixtures.scikit_learn}


def measure(settings: Settings) -> Iterator[Row | Omitted]:
    """Measure two iterations, each library in a process of its own."""
    n_points, n_components = settings.size(1_000_000, 1_300), settings.size(50, 5)
    work = f"EM, N = {n_points}, K = {n_components}, float64: memory above the points"
    try:
        reset_peak()
    except OSError as error:
        yield Omitted(work, f"the peak of the memory cannot be read on this system: {error}")
        return
    used = {
        name: ask("memory", name, n_points, n_components, settings.seed) for name in LIBRARIES
    }
    asked = settings.target("most", 0.3)
    yield Row(work, "GB", used["ours"], "scikit-learn, full", used["scikit-learn"], asked)


def answer(library: str, n_points: int, n_components: int, seed: int) -> float:
    """Measure the memory that a fit takes beyond what is held before [GB]."""
    few = Problem.of(motions(1_300, seed=seed), n_components)
    LIBRARIES[library](few)(1)  # what is loaded and kept once, whatever the points
    fit = LIBRARIES[library](Problem.of(motions(n_points, seed=seed), n_components))
    reset_peak()
    before = peak_memory()
    fit(2)
    return (peak_memory() - before) / 1e9

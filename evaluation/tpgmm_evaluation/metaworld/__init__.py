"""All tasks of Meta-World from few demonstrations: ``make metaworld``."""

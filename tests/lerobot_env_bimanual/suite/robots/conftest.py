"""Robots that cannot be tried have no tests."""

from tests.support.suite_expert import TRIED

collect_ignore = [] if "viperx" in TRIED else ["test_viperx.py"]

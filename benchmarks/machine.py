"""Where, when and with which versions something was measured."""

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

__all__ = ["cores_allowed", "machine"]

PACKAGES = (
    *("tpgmm-torch", "torch", "numpy", "scipy", "scikit-learn", "pomegranate", "gmr", "pin"),
    *("pyarrow", "pytorch-kinematics"),
)


def machine() -> dict[str, Any]:
    """Describe processor, memory, threads, versions, date and load of the machine."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "cores allowed": cores_allowed(),
        "memory [GB]": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "threads": torch.get_num_threads(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "blas": "mkl" if torch.backends.mkl.is_available() else "other",
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "load average": os.getloadavg(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def cores_allowed() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None

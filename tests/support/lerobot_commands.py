"""Running LeRobot's commands, as a user does: in a process of their own."""

import os
import subprocess
import sys
from pathlib import Path

PLUGINS = Path(__file__).parent / "plugins"


def lerobot(
    command: str, *arguments: object, home: Path, drawing: str = "disabled"
) -> subprocess.CompletedProcess[str]:
    """Run ``lerobot-<command>``, offline; the robot of the tests is installed for it.

    Pictures are blank, unless MuJoCo's way of ``drawing`` is named.
    """
    metadata = home / "lerobot_robot_bimanual-0.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True, exist_ok=True)
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_robot_bimanual\nVersion: 0\n")
    path = os.environ.get("PYTHONPATH", "")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (str(PLUGINS), str(home), path))),
        "HF_HOME": str(home / "huggingface"),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "MUJOCO_GL": drawing,
        "SLURM_JOB_ID": "1",  # no progress bars
    }
    script = Path(sys.executable).with_name(f"lerobot-{command}")
    return subprocess.run(
        [script, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )

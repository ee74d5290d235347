"""Commands, run in this process or, by a cluster's workers, in another."""

import subprocess
import sys
from pathlib import Path

from mirror_ppl.console import run

ON_CLUSTER = """
import importlib
import sys
from distributed import LocalCluster
sys.path.insert(0, {tests!r})
from running import command

if __name__ == "__main__":
    module = importlib.import_module(sys.argv[1])
    options = dict(n_workers=1, threads_per_worker=1, dashboard_address=None)
    with LocalCluster(**options) as cluster:
        sys.exit(command(module, *sys.argv[2:], "--scheduler", cluster.scheduler_address))
"""


def command(module, *args):
    """The exit status of a command of the package with these arguments."""
    return run(
        module.Options,
        module.main,
        prog=module.PROGRAM,
        description=module.DESCRIPTION,
        args=[str(arg) for arg in args],
    )


def command_on_cluster(folder, module, *args):
    """What came of a command whose work a Dask cluster on this machine does."""
    script = folder / "on_cluster.py"
    script.write_text(ON_CLUSTER.format(tests=str(Path(__file__).parent)))
    words = [sys.executable, script, module.__name__, *args]
    return subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False, timeout=200
    )

"""The command line: `mrac-jax`, or `python -m mrac_jax`.

The folder that holds our three packages comes first on this process's path, and so on that of the workers it starts,
before anything else is imported: a `planner.py` or `analysis/` of the user's own on PYTHONPATH changes nothing.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    """Run the command line of this process and exit with its status."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from analysis.cli.start import main as run

    run()


if __name__ == "__main__":
    main()

"""`active3d` with the toy stages in place of the real ones, for tests that need a process of their own."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from tests.pipeline import toy

    sys.modules["stages.registry"] = toy
    from active3d_pipe.cli.main import main

    main()

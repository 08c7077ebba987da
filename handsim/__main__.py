"""`python -m handsim` is `handsim`, also where no folder of programs is on the path."""

import sys

from handsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

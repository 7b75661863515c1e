"""`python -m jaxsph`: the same as the command `jaxsph`."""

import sys

from jaxsph.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

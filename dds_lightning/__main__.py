"""`python -m dds_lightning` is `dds`."""

import sys

from dds_lightning.cli import main

if __name__ == "__main__":
    sys.exit(main())

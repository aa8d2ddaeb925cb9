"""``python -m warpmag.examples NAME``."""

import sys

from warpmag.examples import main

if __name__ == "__main__":
    sys.exit(main())

"""``python -m kontronik_can_gw``."""

import sys

from kontronik_can_gw.cli import main

sys.exit(main())

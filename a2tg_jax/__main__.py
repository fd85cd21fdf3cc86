"""`python -m a2tg_jax`, the command `a2tg`."""

import sys

from a2tg_jax.cli.main import main

sys.exit(main())

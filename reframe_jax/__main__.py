"""``python -m reframe_jax``: the command line."""

from reframe_jax.cli import main

raise SystemExit(main())

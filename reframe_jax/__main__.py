"""``python -m reframe_jax``: the command line."""

from reframe_jax.cli.process import main

raise SystemExit(main())

"""`python -m unips_jax`: the `unips` command."""

from unips_jax.cli.main import main

raise SystemExit(main())

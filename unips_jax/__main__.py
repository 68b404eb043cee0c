"""`python -m unips_jax`: the `unips` command."""

import signal

# While modules are imported Ctrl-C ends the process, without a traceback.
_before = signal.signal(signal.SIGINT, signal.SIG_DFL)

from unips_jax.cli.main import main  # noqa: E402

signal.signal(signal.SIGINT, _before)
raise SystemExit(main())

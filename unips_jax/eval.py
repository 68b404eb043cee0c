"""`python -m unips_jax.eval` is `unips eval`; what it does is in `cli/evaluate.py`."""

import sys

from unips_jax.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())

"""`python -m tuning` is `torchblur`; `torchrun -m tuning` starts it in several processes."""

from __future__ import annotations

from tuning.cli import main

if __name__ == "__main__":
    main()

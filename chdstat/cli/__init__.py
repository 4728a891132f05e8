"""Command line: parse, call, report, exit code. No work is done here."""

from __future__ import annotations

# Importing a module of commands enters them; the order is that of the help.
# isort: off
from chdstat.cli.program import app, main
from chdstat.cli import sampling, estimation, reports
# isort: on

__all__ = ["app", "estimation", "main", "reports", "sampling"]
